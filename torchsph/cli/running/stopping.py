"""SIGTERM and SIGUSR1, by which schedulers say that a job's time is up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from types import FrameType, TracebackType

from torchsph.methods.runtime.watching import Stopped

SIGNALS = (signal.SIGTERM, signal.SIGUSR1)


Handler = Callable[[int, FrameType | None], object]


@contextmanager
def handled(signals: Sequence[signal.Signals], handler: Handler) -> Iterator[None]:
    """Let a handler take signals meanwhile; outside the main thread, where none arrives, they stay their owner's."""
    main = threading.current_thread() is threading.main_thread()
    before = {one: signal.signal(one, handler) for one in signals} if main else {}
    try:
        yield
    finally:
        for one, former in before.items():
            signal.signal(one, signal.SIG_DFL if former is None else former)


class StopSignals:
    """A context in which those signals end the work by ``Stopped``: at once, or at its next resting place.

    Attributes:
        waits: whether the work will look at ``asked`` by itself; a second signal ends it all the same.
        asked: whether a signal has come.
    """

    _handled: AbstractContextManager[None]

    def __init__(self) -> None:
        self.waits, self.asked = False, False

    def __enter__(self) -> StopSignals:
        self._handled = handled(SIGNALS, self._come)
        self._handled.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self._handled.__exit__(None, None, None)

    def _come(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked, True
        if again or not self.waits:
            raise Stopped(f"stopped by {signal.Signals(number).name}")
