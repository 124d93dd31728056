"""Frames of one recording at the times of another: when two instants are one."""

from __future__ import annotations

import numpy as np

import geometry

SAME_TIME = 1e-6
"""Frames closer than this (s) are the same instant: far below any frame interval, far above round-off."""


def frame_at(times: np.ndarray, time: float) -> int | None:
    """The frame among `times` (T,), s, that shows the instant `time` (s), or None where there is none."""
    gaps = np.abs(np.asarray(times) - time)
    nearest = int(gaps.argmin())
    return nearest if gaps[nearest] < SAME_TIME else None


def matching_frames(times: np.ndarray, among: np.ndarray, what: str) -> np.ndarray:
    """Indices into `among` of the frames at `times` (s); `ValueError` if one is missing."""
    nearest = np.abs(np.asarray(among)[None, :] - np.asarray(times)[:, None]).argmin(1)
    missing = np.abs(np.asarray(among)[nearest] - times) > SAME_TIME
    if missing.any():
        raise ValueError(
            f"{what} has no frame at {float(np.asarray(times)[missing][0]):.6g} s ({int(missing.sum())} of "
            f"{len(times)} times missing); give one with a frame at every time of the measurement"
        )
    return nearest


def on_frames_of(other: geometry.Recording, recording: geometry.Recording, what: str) -> geometry.Recording:
    """The frames of `other` at the times of `recording`, refused where its grid is another one."""
    mine, its = recording.grid, other.grid
    same = tuple(mine.shape) == tuple(its.shape) and np.allclose(mine.spacing, its.spacing, rtol=1e-6)
    if not same or not np.allclose(mine.origin, its.origin, atol=1e-3 * float(np.min(mine.spacing))):
        raise ValueError(
            f"{what} lies on another grid than the recording ({_grid_text(its)}; not {_grid_text(mine)}); "
            "sample it onto the recording's grid first"
        )
    return other.select(matching_frames(recording.time, other.time, what))


def _grid_text(grid: geometry.Grid) -> str:
    return f"shape {tuple(grid.shape)}, origin {tuple(grid.origin)}, spacing {tuple(grid.spacing)}"
