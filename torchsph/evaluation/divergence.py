"""Divergence of a velocity grid by central differences, and the nodes at which they stay inside a mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .scores import Score, rms_score

_MIDDLE, _AFTER, _BEFORE = slice(1, -1), slice(2, None), slice(None, -2)


def divergence_rms(velocity: np.ndarray, mask: np.ndarray, spacing: Sequence[float]) -> Score:
    """RMS divergence, 1/s, of a velocity (T, D, *shape), m/s, on a grid of `spacing` (D,), m (x first)."""
    sums, counts = np.zeros(len(mask)), np.zeros(len(mask), int)
    for frame, inside in enumerate(mask):
        interior = interior_nodes(inside)
        divergence = central_divergence(velocity[frame].astype(np.float64), spacing)
        sums[frame], counts[frame] = np.sum(divergence[interior] ** 2), interior.sum()
    return rms_score(sums, counts, 1.0)


def central_divergence(velocity: np.ndarray, spacing: Sequence[float]) -> np.ndarray:
    """Second-order central differences of (D, *shape); the nodes on the border of the grid hold 0."""
    divergence = np.zeros(velocity.shape[1:])
    for component, step in enumerate(np.asarray(spacing, float)):
        axis = velocity.ndim - 2 - component  # components run x, y, z; array axes z, y, x
        middle, after, before = (_along(divergence.ndim, axis, s) for s in (_MIDDLE, _AFTER, _BEFORE))
        divergence[middle] += (velocity[component][after] - velocity[component][before]) / (2 * step)
    return divergence


def _along(dimension: int, axis: int, part: slice) -> tuple[slice, ...]:
    return tuple(part if a == axis else slice(None) for a in range(dimension))


def interior_nodes(inside: np.ndarray) -> np.ndarray:
    """(*shape) bool, nodes of a mask (*shape) that have both neighbours along every axis in it."""
    interior = inside.copy()
    for axis in range(inside.ndim):
        whole = np.zeros_like(inside)
        whole[_along(inside.ndim, axis, _MIDDLE)] = (
            inside[_along(inside.ndim, axis, _AFTER)] & inside[_along(inside.ndim, axis, _BEFORE)]
        )
        interior &= whole
    return interior
