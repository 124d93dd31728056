"""How far a run is, as a line of JSON for each frame, for whoever looks after many runs."""

from __future__ import annotations

import json
import resource
import time
from collections import deque
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType

from torchsph.methods.runtime.watching import FrameDone
from torchsph.methods.runtime.workers import memory_of_workers

from ..exit_codes import ExitCode, exit_code
from .notes import LOGGER
from .stopping import StopSignals

# frames whose seconds tell how long the others will take
_RECENT = 5


class StatusFile:
    """Lines appended to a file while a run is on; a file that cannot be written to is told once and then left alone.

    Every line has ``time`` (ISO 8601, UTC), ``event`` ("begun", "frame", "done", "stopped", "failed"), ``seconds``
    since the run began, ``memory`` and ``peak`` in bytes. A frame has ``frame`` (from 1), ``frames``, ``alive``,
    ``members``, ``left`` (s) and ``end``, when it will be over; the last line has the exit ``code``.

    Args:
        path: of the file; None writes nothing.
    """

    def __init__(self, path: str | Path | None) -> None:
        self.path, self.began = path, time.monotonic()

    def __enter__(self) -> StatusFile:
        self.write("begun")
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        if fault is None:
            self.write("done", code=int(ExitCode.DONE))
        else:
            code = exit_code(fault)
            event = "stopped" if code in (ExitCode.RESUME, ExitCode.INTERRUPTED) else "failed"
            self.write(event, code=int(code), message=str(fault))

    def write(self, event: str, **more: object) -> None:
        """Append a line."""
        if self.path is None:
            return
        told = {
            "time": _iso(0.0),
            "event": event,
            "seconds": round(time.monotonic() - self.began, 3),
            **_memory(),
            **more,
        }
        try:
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps(told) + "\n")
        except OSError as fault:
            LOGGER.warning("--status %s: cannot be written (%s); the run goes on without it", self.path, fault.strerror)
            self.path = None


class RunWatcher:
    """Looks on while an ensemble runs: writes its status, and hands on a request to stop.

    Args:
        signals: by which a scheduler asks.
        status: where it is told.
    """

    def __init__(self, signals: StopSignals, status: StatusFile) -> None:
        self.signals, self.status = signals, status
        self._times: deque[float] = deque(maxlen=_RECENT + 1)

    def begins(self) -> None:
        """See :class:`Watcher`."""
        self.signals.waits = True
        self._times.append(time.monotonic())

    def frame_done(self, done: FrameDone) -> None:
        """See :class:`Watcher`."""
        self._times.append(time.monotonic())
        each = (self._times[-1] - self._times[0]) / (len(self._times) - 1)
        left = each * (done.frames - done.frame - 1)
        self.status.write(
            "frame",
            frame=done.frame + 1,
            frames=done.frames,
            alive=done.alive,
            members=done.members,
            left=round(left, 3),
            end=_iso(left),
        )
        LOGGER.debug(
            "frame %d of %d, %d of %d members alive, about %.0f s left",
            done.frame + 1,
            done.frames,
            done.alive,
            done.members,
            left,
        )

    def asked_to_stop(self) -> bool:
        """See :class:`Watcher`."""
        return self.signals.asked


def _iso(ahead: float) -> str:
    return (datetime.now(UTC) + timedelta(seconds=ahead)).isoformat(timespec="seconds")


def _memory() -> dict[str, int]:
    """Bytes of this process and its workers now and at most so far."""
    workers, most = memory_of_workers()
    own = _own_memory()
    return {"memory": own["memory"] + workers, "peak": own["peak"] + most}


def _own_memory() -> dict[str, int]:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):  # not Linux
        return {"memory": peak, "peak": peak}
    return {"memory": pages * resource.getpagesize(), "peak": peak}
