"""What the exit code of a command says, and which fault ends in which."""

from __future__ import annotations

from enum import IntEnum

from torchsph.methods.runtime.watching import Stopped


class ExitCode(IntEnum):
    """The exit codes; a scheduler runs an item again after RESUME, and after nothing else without a change."""

    DONE = 0
    OURS = 1  # a fault of torchsph, or of what it is built on
    INPUT = 2  # a file, an option or a place to write to is at fault
    MEMORY = 3  # it needs more memory than there is
    NUMERICAL = 4  # the computation broke down
    RESUME = 75  # asked to stop: run it again, with --resume where there are checkpoints (EX_TEMPFAIL of sysexits.h)
    INTERRUPTED = 130  # by Ctrl-C


def exit_code(fault: BaseException) -> ExitCode:
    """The code that a fault ends a command with."""
    if isinstance(fault, Stopped):
        return ExitCode.RESUME
    if isinstance(fault, KeyboardInterrupt):
        return ExitCode.INTERRUPTED
    if isinstance(fault, MemoryError) or _allocation(fault):
        return ExitCode.MEMORY
    if _numerical(fault):
        return ExitCode.NUMERICAL
    return ExitCode.INPUT if isinstance(fault, ValueError | OSError) else ExitCode.OURS


def _allocation(fault: BaseException) -> bool:
    """Whether torch found no memory: it has no type of its own for that on the CPU."""
    words = str(fault).lower()
    known = ("can't allocate memory", "out of memory", "storage size calculation overflowed")
    return isinstance(fault, RuntimeError) and any(part in words for part in known)


def _numerical(fault: BaseException) -> bool:
    # here, because they bring torch along, which a command that never computes has no need of
    from numpy.linalg import LinAlgError

    import regularize
    from torchsph.simulator.failures import NumericalFailure

    return isinstance(fault, NumericalFailure | regularize.NotConverged | LinAlgError | ArithmeticError)
