"""A call in a child process with limits of memory and time, so that whatever it does costs the child alone."""

from __future__ import annotations

import json
import math
import os
import resource
import select
import signal
import time
from collections.abc import Callable
from pathlib import Path

MEMORY = 4 << 30  # bytes beyond what the process has
WAITING = 20  # times the limit, by the clock: others may keep the processor busy


def in_child(call: Callable[[], tuple[str, str]], limit: float) -> tuple[str, str]:
    """What a call answers, a kind and a text; or how its child died: ("hang", ...) or ("crash", ...).

    What the call prints is thrown away.

    Args:
        call: what is done.
        limit: s of processor time; after them, or ``WAITING`` times as long by the clock, the child is killed.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(limit), math.ceil(limit) + 1))
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        with os.fdopen(writer, "w", encoding="utf-8", errors="replace") as pipe:
            json.dump(call(), pipe)
        os._exit(0)
    os.close(writer)
    answer, end = b"", time.monotonic() + WAITING * limit
    while select.select([reader], [], [], max(0.0, end - time.monotonic()))[0]:
        part = os.read(reader, 1 << 16)
        if not part:
            break
        answer += part
    else:
        os.kill(child, signal.SIGKILL)
    os.close(reader)
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        stopped = number in (signal.SIGKILL, signal.SIGXCPU)
        return ("hang", f"more than {limit:g} s") if stopped else ("crash", f"signal {number}")
    if not answer:
        return "crash", "no answer"
    kind, text = json.loads(answer)
    return kind, text
