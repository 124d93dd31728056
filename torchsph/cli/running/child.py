"""One item of many in a process of its own: its crash, hang or hunger costs that item."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchsph.methods.runtime.watching import Stopped

from ..exit_codes import ExitCode
from .stopping import SIGNALS, handled

# s that a child has to end after it was asked to, before it is killed
GRACE = 60.0


@dataclass(frozen=True)
class Outcome:
    """How a child ended.

    Attributes:
        code: an ``ExitCode``.
        seconds: that it took.
        message: its last words, where it failed.
    """

    code: int
    seconds: float
    message: str = ""


def run_child(arguments: Sequence[str], log: Path, limit: float | None = None) -> Outcome:
    """Run ``torchsph`` with arguments in a child process whose output is appended to a log.

    A request to stop this process is handed on to the child, and waits for it.

    Args:
        arguments: the command and its options.
        log: a file, made where it is not there; never a link.
        limit: s, after which the child is asked to stop, and killed ``GRACE`` later; None waits.
    """
    began = time.monotonic()
    handle = os.open(log, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    try:
        start = os.fstat(handle).st_size
        call = [sys.executable, "-m", "torchsph", *arguments]
        late = False
        came: list[int] = []
        # kept meanwhile: a request to stop that struck amid the start of a child would leave it behind
        with handled((*SIGNALS, signal.SIGINT), lambda number, frame: came.append(number)):
            process = subprocess.Popen(call, stdin=subprocess.DEVNULL, stdout=handle, stderr=handle)
        try:
            try:
                for number in came:
                    signal.raise_signal(number)
                status = process.wait(limit)
            except subprocess.TimeoutExpired:
                late, status = True, _ended(process, signal.SIGTERM)
        except (Stopped, KeyboardInterrupt) as asked:
            _ended(process, signal.SIGTERM if isinstance(asked, Stopped) else signal.SIGINT)
            raise
        last = _last_line(handle, start)
    finally:
        os.close(handle)
    seconds = time.monotonic() - began
    if late:
        return Outcome(ExitCode.OURS, seconds, f"took longer than {limit:g} s and was stopped")
    if status >= 0:
        return Outcome(status, seconds, last if status else "")
    name = signal.Signals(-status).name
    if status == -signal.SIGKILL:
        return Outcome(ExitCode.MEMORY, seconds, f"was killed ({name}), most likely because memory ran out")
    return Outcome(ExitCode.OURS, seconds, f"crashed ({name})")


def _ended(process: subprocess.Popen[bytes], by: signal.Signals) -> int:
    """The status of a child that is asked to end, and made to after a while."""
    process.send_signal(by)
    try:
        return process.wait(GRACE)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _last_line(handle: int, start: int) -> str:
    """The last line of a log that was written since ``start`` (bytes)."""
    size = os.fstat(handle).st_size
    first = max(start, size - 4096)
    lines = os.pread(handle, size - first, first).decode("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines else ""
