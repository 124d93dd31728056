"""Splines of single frames averaged over time, by a width that the frames themselves choose.

Each frame's spline knows nothing of its neighbours; where the flow changes little from one frame to the next, their
mean has less noise. A Gaussian average over time (Nadaraya 1964; Watson 1964) is taken of all but the flow that the
walls alone drive, which is known in every frame and keeps its timing. Its width is that by which each frame is told
best from the others, itself left out (Stone 1974): noise asks for a wide one, a flow that changes for a narrow one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

import geometry
from geometry.arguments import checked

from .frame_splines import FrameSmoother
from .wall_balance import WallBalance

__all__ = ["AveragedOverTime", "average_over_time"]

# widths that are tried, in intervals between frames: from one that leaves a frame .98 of its own weight on
_NARROWEST, _WIDEST, _TRIED = 0.35, 4.0, 13
_REACH = 3.0  # widths, beyond which frames count for nothing
_SAMPLED = 20_000  # nodes, about, by which the width is chosen


class AveragedOverTime(NamedTuple):
    """What an average has made.

    Attributes:
        recording: the fields.
        width: standard deviation of the Gaussian, s; 0: nothing was averaged.
    """

    recording: geometry.Recording
    width: float


@checked
def average_over_time(
    smoothed: geometry.Recording, splines: FrameSmoother, width: float | None = None, balance: WallBalance | None = None
) -> AveragedOverTime:
    """Average the fields of neighbouring frames.

    Args:
        smoothed: the splines of single frames (`smooth_frames`).
        splines: that made them, and know which frames measured anything: the others are filled from their neighbours.
        width: standard deviation of the Gaussian, s; None: by the frames themselves.
        balance: of mass between the walls, whose flow is left out of the average; None: all of the flow is averaged.

    Raises:
        ValueError: the width is negative or no number.
    """
    if width is not None and not (np.isfinite(width) and width >= 0):
        raise ValueError(f"average_over_time: the width must be a number of seconds from 0 on, got {width}")
    measured = np.array([splines.measures(frame) for frame in range(smoothed.frames)])
    if int(measured.sum()) < 3 or width == 0:
        return AveragedOverTime(smoothed, 0.0)
    mask = np.asarray(smoothed.mask, bool)
    used = mask & measured[(...,) + (None,) * smoothed.dimension]
    known = np.zeros_like(smoothed.velocity)
    if balance is not None:
        known = np.stack([balance.known(frame) for frame in range(smoothed.frames)])
    rest = np.where(used[:, None], smoothed.velocity - known, 0.0).astype(np.float64)
    apart = _apart(smoothed)
    if width is None:
        width = _chosen(rest, used, apart)
    found, there = _mean(rest, used, _weights(apart, width))
    fields = np.where(mask[:, None], np.where(there[:, None], found, rest) + known, 0.0).astype(np.float32)
    uncovered = np.count_nonzero(mask & ~there, axis=tuple(range(1, mask.ndim)))
    text = f"penalised B-spline, frame by frame, averaged over {1e3 * width:.3g} ms"
    return AveragedOverTime(smoothed.with_velocity(fields, uncovered=uncovered, description=text), width)


def _apart(recording: geometry.Recording) -> NDArray[np.float64]:
    """(T, T) s between frames; round the period the shorter way."""
    apart = np.abs(recording.time[:, None] - recording.time[None])
    return np.minimum(apart, np.abs(recording.period - apart)) if recording.period > 0 else apart


def _weights(apart: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """(T, T) of the frames in each mean."""
    return np.where(apart <= _REACH * width * (1 + 1e-9), np.exp(-0.5 * (apart / width) ** 2), 0.0)


def _mean(
    fields: NDArray[np.float64], used: NDArray[np.bool_], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Weighted means (T, D, ...) over the frames in which a node of `used` (T, ...) is, and where there are any."""
    few = csr_array(weights)  # each frame has but few neighbours
    total = (few @ used.reshape(len(used), -1).astype(np.float64)).reshape(used.shape)
    found = (few @ fields.reshape(len(fields), -1)).reshape(fields.shape)
    there = total > 1e-6 * weights.max(axis=1).reshape(-1, *[1] * (used.ndim - 1))
    return found / np.where(there, total, 1.0)[:, None], there


def _chosen(fields: NDArray[np.float64], used: NDArray[np.bool_], apart: NDArray[np.float64]) -> float:
    """The width, s, by which frames are told best from the others, RMS over a sample of the nodes."""
    present = used.any(axis=tuple(range(1, used.ndim)))
    others = np.where(np.eye(len(apart), dtype=bool) | ~present, np.inf, apart)
    nearest = others.min(1)
    step = float(np.median(nearest[present]))
    ever = np.flatnonzero(used.any(0))
    nodes = ever[:: max(1, len(ever) // _SAMPLED)]
    fields, used = fields.reshape(*fields.shape[:2], -1)[:, :, nodes], used.reshape(len(used), -1)[:, nodes]
    errors = {}
    for width in np.geomspace(_NARROWEST * step, _WIDEST * step, _TRIED).tolist():
        weights = np.where(np.isfinite(others), _weights(np.where(np.isfinite(others), others, 0.0), width), 0.0)
        alone = weights.max(1) == 0  # a gap wider than the reach: the nearest frame tells
        weights[alone] = (others == nearest[:, None])[alone]
        found, there = _mean(fields, used, weights)
        both = (there & used)[:, None]
        errors[width] = float((np.square(found - fields) * both).sum() / max(int(both.sum()), 1))
    return min(errors, key=lambda each: errors[each])
