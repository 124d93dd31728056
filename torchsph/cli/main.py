"""The command `torchsph`: a thin layer over the Python interface, which is the product.

Results go to stdout as a small table, progress and notes to stderr. What the exit codes say stands in
`exit_codes.py`. Every failure is one line on stderr, never a traceback.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
from collections.abc import Sequence

__all__ = ["main"]

DEBUG = "TORCHSPH_TRACEBACK"
"""Environment variable that adds the traceback to the one line, for those who look for a defect."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code (argparse itself leaves with 2 by `SystemExit`)."""
    args: argparse.Namespace | None = None
    _keep_threads_calm()
    try:
        # here, so that an interruption of the long imports is one as well
        from .program import parsed
        from .running.notes import told
        from .running.stopping import StopSignals

        args = parsed(sys.argv[1:] if arguments is None else arguments)
        with told(args), StopSignals():
            code = args.run(args) or 0
        if sys.stdout is not None:  # closed by the caller: the files are what counts
            sys.stdout.flush()
    except BrokenPipeError:  # the reader of the table went away (`| head`); nothing is wrong here
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except SystemExit:
        raise
    except BaseException as fault:
        return _failed(fault, args)
    return int(code)


def _keep_threads_calm() -> None:
    """Let threads that wait for others sleep, where nobody has said otherwise and torch is not loaded yet.

    By default they spin, at the end of each of thousands of small parallel regions; on a machine that is shared they
    then wait for threads which the system has taken away, and keep these from coming back. The small matrices of numpy
    and scipy are faster on one thread.
    """
    if "torch" not in sys.modules:
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _failed(fault: BaseException, args: argparse.Namespace | None) -> int:
    """Tell a fault in one line, and return its code."""
    from .cures import late_fault
    from .exit_codes import ExitCode, exit_code
    from .running import notes

    if os.environ.get(DEBUG):
        traceback.print_exc()
    code = exit_code(fault)
    text = late_fault(fault, code, args) or _text(fault, code is ExitCode.OURS)
    if code is ExitCode.RESUME:
        text += f"; run it again{' with --resume' if hasattr(args, 'resume') else ''} to go on"
    notes.fault("" if args is None else args.command, text, int(code), args)
    return int(code)


def _text(fault: BaseException, ours: bool) -> str:
    if isinstance(fault, KeyboardInterrupt):
        return "interrupted"
    if isinstance(fault, OSError) and fault.filename is not None and fault.strerror:
        return f"{fault.filename}: {fault.strerror}"
    return f"{type(fault).__name__}: {fault} ({DEBUG}=1 shows where)" if ours else str(fault)
