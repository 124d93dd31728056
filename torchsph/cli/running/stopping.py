"""SIGTERM and SIGUSR1, by which schedulers say that a job's time is up."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any

from torchsph.methods.runtime.watching import Stopped

SIGNALS = (signal.SIGTERM, signal.SIGUSR1)


class StopSignals:
    """A context in which those signals end the work by ``Stopped``: at once, or at its next resting place.

    Attributes:
        waits: whether the work will look at ``asked`` by itself; a second signal ends it all the same.
        asked: whether a signal has come.
    """

    def __init__(self) -> None:
        self.waits, self.asked = False, False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopSignals:
        try:
            self._before = {one: signal.signal(one, self._come) for one in SIGNALS}
        except ValueError:  # not in the main thread: whoever called owns the signals
            self._before = {}
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        for one, handler in self._before.items():
            signal.signal(one, signal.SIG_DFL if handler is None else handler)

    def _come(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked, True
        if again or not self.waits:
            raise Stopped(f"stopped by {signal.Signals(number).name}")
