"""How a long run tells how far it is, and how it is told to stop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Stopped(BaseException):
    """A run has stopped because it was asked to, and can be gone on from; no fault, so no ``Exception``."""


@dataclass(frozen=True)
class FrameDone:
    """How far a run is.

    Attributes:
        frame: number of the frame that has its analysis, from 0.
        frames: how many there are.
        alive: members whose forecast of the frame did not fail.
        members: how many there are.
    """

    frame: int
    frames: int
    alive: int
    members: int


class Watcher(Protocol):
    """What looks on while frames are done one after another."""

    def begins(self) -> None:
        """From here on every frame leaves a checkpoint: a request to stop waits until the frame is done."""

    def frame_done(self, done: FrameDone) -> None:
        """A frame has its analysis, and its checkpoint where there is one."""

    def asked_to_stop(self) -> bool:
        """Whether the run is to end here."""
