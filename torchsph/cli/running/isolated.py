"""Work on a file that is not trusted, in a child process with limits: its fault costs the child alone."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

# what the reading of a file may take: s; bytes, and as many for each of its own
SECONDS_TO_READ = 120.0
_LEAST_MEMORY, _TIMES_SIZE = 2 << 30, 50

_KINDS: tuple[type[Exception], ...] = (MemoryError, FileNotFoundError, OSError, ValueError)


def memory_to_read(file: str | Path) -> int:
    """Bytes that the reading of a file may take."""
    return _LEAST_MEMORY + _TIMES_SIZE * Path(file).stat().st_size


def isolated(work: Callable[[], T], what: str, *, seconds: float, memory: int) -> T:
    """The result of work that a child process does.

    The child is a fork: it has all modules already. Threads of the parent do not exist in it, so torch runs on one.

    Args:
        work: whose result is plain: numbers, texts, lists and dictionaries, as JSON has them.
        what: it is done to, a file's name; it opens the message.
        seconds: after which the child is killed.
        memory: bytes that it may take beyond what this process has.

    Raises:
        ValueError: the child crashed, was too slow or too large, or raised a ValueError itself.
        OSError: the child raised one.
        MemoryError: the child raised one.
    """
    sys.stdout.flush()
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        _work(work, writer, memory)
    os.close(writer)
    try:
        answer, late = _answer(reader, seconds)
        if late:
            os.kill(child, signal.SIGKILL)
    except BaseException:
        os.kill(child, signal.SIGKILL)
        raise
    finally:
        os.close(reader)
        status = os.waitpid(child, 0)[1]
    if late:
        raise ValueError(f"{what}: reading it took longer than {seconds:g} s and was stopped; the file may be damaged")
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        raise ValueError(f"{what}: reading it ended a process by {name}; the file is damaged, make it anew")
    if not answer:
        raise ValueError(f"{what}: reading it ended a process without a word; the file is damaged, make it anew")
    try:
        result, kind, message = json.loads(answer)
    except ValueError:
        raise ValueError(f"{what}: reading it ended a process in the middle of a word; the file is damaged") from None
    if kind is not None:
        raise _KINDS[kind](message) if kind >= 0 else RuntimeError(message)
    found: T = result
    return found


def _work(work: Callable[[], T], writer: int, memory: int) -> None:
    """The child's whole life."""
    try:
        for one in (signal.SIGTERM, signal.SIGUSR1, signal.SIGINT):
            signal.signal(one, signal.SIG_DFL)
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(1)
        limit = _address_space() + memory
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.disable()
        answer: tuple[object, int | None, str] = (work(), None, "")
    except Exception as fault:
        number = next((n for n, kind in enumerate(_KINDS) if isinstance(fault, kind)), -1)
        text = str(fault) if number >= 0 else f"{type(fault).__name__}: {fault}"
        answer = (None, number, text or "out of memory")
    try:
        sys.stdout.flush()
        with os.fdopen(writer, "w", encoding="utf-8", errors="backslashreplace") as pipe:
            json.dump(answer, pipe)
    finally:
        os._exit(0)


def _answer(reader: int, seconds: float) -> tuple[bytes, bool]:
    """All that the child writes, and whether it was not done in time."""
    end = time.monotonic() + seconds
    parts: list[bytes] = []
    while True:
        ready, _, _ = select.select([reader], [], [], max(0.0, end - time.monotonic()))
        if not ready:
            return b"", True
        part = os.read(reader, 1 << 20)
        if not part:
            return b"".join(parts), False
        parts.append(part)


def _address_space() -> int:
    """Bytes of address space that this process has; torch reserves far more than it uses."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[0]) * resource.getpagesize()
