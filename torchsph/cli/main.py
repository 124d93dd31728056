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

__all__ = ["main"]

DEBUG = "TORCHSPH_TRACEBACK"
"""Environment variable that adds the traceback to the one line, for those who look for a defect."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (argparse itself leaves with 2 by `SystemExit`)."""
    from .program import build_parser

    args = build_parser().parse_args(arguments)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            args.run(args)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _fail(args.command, "interrupted", 130)
    except BrokenPipeError:  # the reader of the table went away (`| head`); nothing is wrong here
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError) as error:
        return _fail(args.command, _text(error), 2)
    except MemoryError:
        return _fail(args.command, "out of memory; try fewer --members or a larger --spacing", 1)
    except Exception as error:
        return _fail(args.command, f"{type(error).__name__}: {error} ({DEBUG}=1 shows where)", 1)
    return 0


def _warn(message: Warning | str, category: type[Warning], *_: object) -> None:
    """One line for what the user should know; what is meant for programmers stays silent."""
    if category is UserWarning:
        print(f"torchsph: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _fail(command: str, message: str, code: int) -> int:
    if os.environ.get(DEBUG):
        traceback.print_exc()
    print(f"torchsph {command}: error: {' '.join(message.split())}", file=sys.stderr)
    return code
