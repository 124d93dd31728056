"""Members of a spline: draws from the posterior of its coefficients, frame by frame.

The coefficients of a penalised fit are normal around the fit with the inverse of its normal equations, times the
noise's variance, for covariance (Wahba 1983; `FrameSmoother.draws`). Frames are fitted one by one, so that draws of
different frames know nothing of one another, and du/dt by differences of frames carries the errors of all of them: that
is what splines know of the pressure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray

import geometry
from torchsph.haemodynamics.fields.acceleration import time_derivative

from ..measurement.frame_splines import FrameSmoother
from .amplitude import Amplitude
from .frames import MemberFrame
from .resolution import Resolution, seen_again

__all__ = ["spline_frames"]

_ORDER = 2  # of accuracy in time: frames on each side of the one whose du/dt is taken


def spline_frames(
    splines: FrameSmoother,
    smoothed: geometry.Recording,
    members: int,
    *,
    seed: int = 0,
    amplitude: Amplitude | None = None,
    resolution: Resolution | None = None,
) -> Iterator[MemberFrame]:
    """The splines of a recording with members drawn around them; a few frames are held at a time.

    Args:
        splines: the fits, which have chosen noise and smoothness.
        smoothed: what they are on the grid.
        members: N, at least 2.
        seed: of the draws; those of a frame do not depend on which frames came before.
        amplitude: what members are off by as a whole; None: nothing.
        resolution: what shows an estimate once more; None: no kernel is known.

    Raises:
        ValueError: fewer than two members.
    """
    if members < 2:
        raise ValueError(f"a spread needs at least 2 members, not {members}")
    changes = np.unique(smoothed.valve_intervals_or_derived()[:, 1:])
    events = [float(t) for t in changes[np.isfinite(changes)]]
    held: deque[NDArray[np.float32]] = deque()
    first = 0  # frame of the first field that is held
    for frame in range(smoothed.frames):
        while first + len(held) < min(frame + _ORDER + 1, smoothed.frames):
            fields = _drawn(splines, smoothed, first + len(held), members, seed)
            if amplitude is not None:
                fields[1:] += amplitude.of_fields(torch.from_numpy(fields[0]), first + len(held)).numpy()
            held.append(fields)
        while first < frame - _ORDER:
            held.popleft()
            first += 1
        span = slice(first, first + len(held))
        fields, mask, time = np.stack(held), np.asarray(smoothed.mask[span], bool), smoothed.time[span]
        rate = time_derivative(fields, mask, time, frame - first, order=_ORDER, events=events)
        here = held[frame - first]
        again = seen_again(resolution, here[0], rate[0], frame)
        yield MemberFrame(frame, here[0], here[1:], rate[0], rate[1:], None, *again)


def _drawn(
    splines: FrameSmoother, smoothed: geometry.Recording, frame: int, members: int, seed: int
) -> NDArray[np.float32]:
    """(1 + N, D, *shape): the spline of a frame, and draws around it."""
    field = smoothed.velocity[frame]
    if not splines.measures(frame):
        return np.repeat(field[None], 1 + members, axis=0)
    generator = torch.Generator().manual_seed(seed * 1_000_003 + frame)
    fitted = splines.fit(frame, uncertainty=True)
    drawn = splines.draws(fitted, frame, members, generator).numpy()
    return np.concatenate([field[None], field + drawn]).astype(np.float32)
