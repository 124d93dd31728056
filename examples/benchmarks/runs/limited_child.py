"""Calls in a child process with limits of memory and time, so that whatever they do costs the child alone."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

MEMORY = 4 << 30  # bytes beyond what the process has
WAITING = 20  # times the limit, by the clock: others may keep the processor busy


Answer = tuple[str, str]


def in_child(call: Callable[[], Answer], limit: float) -> Answer:
    """What a call answers, a kind and a text; or how its child died: ("hang", ...) or ("crash", ...).

    What the call prints is thrown away.

    Args:
        call: what is done.
        limit: s of processor time; after them, or ``WAITING`` times as long by the clock, the child is killed.
    """
    (answer,) = in_children([call], limit)
    return answer


def in_children(calls: Sequence[Callable[[], Answer]], limit: float) -> Iterator[Answer]:
    """What each of many calls answers, as `in_child` has it: one child makes all, and another the rest where one dies.

    Args:
        calls: what is done, one after the other.
        limit: s of each, as of `in_child`.
    """
    done = 0
    while done < len(calls):
        child, reader = _started(calls[done:], limit)
        left = b""
        while done < len(calls) and select.select([reader], [], [], WAITING * limit)[0]:
            part = os.read(reader, 1 << 16)
            if not part:
                break
            *lines, left = (left + part).split(b"\n")
            for line in lines:
                done += 1
                kind, text = json.loads(line)
                yield kind, text
        os.close(reader)
        if done < len(calls):
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        if done < len(calls):
            done += 1
            number = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
            stopped = number in (signal.SIGKILL, signal.SIGPROF)
            yield ("hang", f"more than {limit:g} s") if stopped else ("crash", f"signal {number}")


def _started(calls: Sequence[Callable[[], Answer]], limit: float) -> tuple[int, int]:
    """The number of a child that makes the calls, and the pipe that its answers come through, one a line."""
    reader, writer = os.pipe()
    child = os.fork()
    if child:
        os.close(writer)
        return child, reader
    os.close(reader)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)  # which ends the process
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    for call in calls:
        signal.setitimer(signal.ITIMER_PROF, limit)
        os.write(writer, json.dumps(call()).encode("utf-8", "replace") + b"\n")
    os._exit(0)
