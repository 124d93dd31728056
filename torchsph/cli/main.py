"""The command `torchsph`: a thin layer over the Python interface, which is the product.

Results go to stdout as a small table, progress and notes to stderr. Exit codes: 0 done; 2 the input or an
option is at fault; 1 the computation failed; 130 interrupted. Every failure is one line on stderr, never a
traceback.
"""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import TextIO

from .terminal import printable

__all__ = ["main"]

DEBUG = "TORCHSPH_TRACEBACK"
"""Environment variable that adds the traceback to the one line, for those who look for a defect."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (argparse itself leaves with 2 by `SystemExit`)."""
    command = ""
    try:
        from .program import build_parser  # here, so that an interruption of the long imports is one as well

        args = build_parser().parse_args(arguments)
        command = args.command
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            args.run(args)
        if sys.stdout is not None:  # closed by the caller: the files are what counts
            sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail(command, "interrupted", 130)
    except BrokenPipeError:  # the reader of the table went away (`| head`); nothing is wrong here
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError) as error:
        return _fail(command, _text(error), 2)
    except MemoryError:
        return _fail(command, "out of memory; try fewer --members or a larger --spacing", 1)
    except Exception as error:
        return _fail(command, f"{type(error).__name__}: {error} ({DEBUG}=1 shows where)", 1)
    return 0


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """One line for what the user should know; what is meant for programmers stays silent."""
    if category is UserWarning:
        print(f"torchsph: warning: {printable(' '.join(str(message).split()))}", file=sys.stderr)


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _fail(command: str, message: str, code: int) -> int:
    if os.environ.get(DEBUG):
        traceback.print_exc()
    line = f"{f'torchsph {command}'.rstrip()}: error: {' '.join(message.split())}"
    print(printable(line), file=sys.stderr)
    return code
