"""What the walls alone say of the flow at a recording's frames, and how far estimates miss it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import geometry
from torchsph.haemodynamics.fields.continuity import MassBalance

from .wall_rows import open_regions

_ASKED = 12  # frames, about, in which an estimate is held against what the walls say


class WallBalance:
    """The balance of mass between a recording's walls, frame by frame; the last frame's is held.

    Args:
        recording: whose masks, walls and valves they are.
        motion: of the walls.
    """

    def __init__(self, recording: geometry.Recording, motion: geometry.WallMotion) -> None:
        self.recording = recording
        self._sampler = geometry.WallSampler(motion, min(recording.grid.spacing))
        self._held: tuple[int, MassBalance] | None = None

    def nearest(self, field: NDArray[np.floating], frame: int) -> NDArray[np.floating]:
        """The nearest field (D, *shape), m/s, that passes what the walls displace; without blood the one given."""
        if not np.any(self.recording.mask[frame]):
            return field
        if self._held is None or self._held[0] != frame:
            time, mask = float(self.recording.time[frame]), np.array(self.recording.mask[frame], bool)
            balance = MassBalance(self.recording.grid, mask, self._sampler.at(time), open_regions(self.recording, time))
            self._held = frame, balance
        return self._held[1].nearest(field).astype(field.dtype)

    def known(self, frame: int) -> NDArray[np.float32]:
        """(D, *shape), m/s: the flow that the walls' motion alone drives, without vorticity.

        Every flow between these walls is this one and a rest that is orthogonal to it: the rest passes no wall, and
        this is a gradient (Chorin & Marsden 1993, sec. 1.3).
        """
        grid = self.recording.grid
        return self.nearest(np.zeros((grid.dimension, *grid.shape), np.float32), frame).astype(np.float32)


def amplitude_error(balance: WallBalance, estimate: geometry.Recording) -> float:
    """How wrong the amplitude of an estimate is, relative, by the part of the flow that is known.

    Whatever the flow, its product with ``WallBalance.known`` is the square of that; what an estimate's product is off
    by tells how much too small or too large it shows a flow. Root mean square over some of the frames, weighed by the
    size of the known flow; 0 where there is none.

    Args:
        balance: of the estimate's walls.
        estimate: fields that were not made to keep it.
    """
    size, missed = 0.0, 0.0
    for frame in range(0, estimate.frames, max(1, round(estimate.frames / _ASKED))):
        known = balance.known(frame).astype(np.float64)
        square = float((known**2).sum())
        if square > 0:
            share = float((known * np.nan_to_num(estimate.velocity[frame])).sum()) / square
            size, missed = size + square, missed + square * (share - 1) ** 2
    return (missed / size) ** 0.5 if size > 0 else 0.0
