"""A field of a masked grid at points: interpolated inside the blood, and on a plane through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

import geometry

__all__ = ["PlaneSection", "plane_section", "sample_in_mask"]

Array = NDArray[np.float64]

HALF = 0.5
"""Points count as blood where at least this share of the nodes around them does: the mask's own border."""


def sample_in_mask(grid: geometry.Grid, field: ArrayLike, mask: ArrayLike, points: ArrayLike) -> tuple[Array, Array]:
    """Field `(*lead, n)` at points from the nodes of the mask alone, and their share of the weights `(n,)`.

    Multilinear weights renormalised over the mask, so that the zeros beyond the wall do not enter; 0 where no node of
    the mask lies around a point.

    Args:
        grid: the nodes.
        field: `(*lead, *shape)`.
        mask: bool `(*shape)`.
        points: `(n, D)`, m.
    """
    inside = torch.from_numpy(np.asarray(mask, bool)).double()
    stencil = grid.stencil(torch.from_numpy(np.asarray(points, np.float64)), outside="zero")
    share = grid.sample(inside, stencil)
    values = grid.sample(torch.from_numpy(np.where(np.asarray(mask, bool), field, 0.0)).double(), stencil)
    covered = share > 1e-6
    return (values / torch.where(covered, share, 1.0) * covered).numpy(), share.numpy()


@dataclass(frozen=True, eq=False)
class PlaneSection:
    """The blood in a plane, on pixels: point = `centre` + s `across` + t `along`.

    Args:
        centre: `(3,)`, m.
        across: unit vector `(3,)`.
        along: unit vector `(3,)`; across x along is the normal.
        s: pixel coordinates along `across`, `(ns,)`, m.
        t: pixel coordinates along `along`, `(nt,)`, m.
        inside: bool `(nt, ns)`, pixels in the blood.
    """

    centre: Array
    across: Array
    along: Array
    s: Array
    t: Array
    inside: NDArray[np.bool_]

    @property
    def normal(self) -> Array:
        """Unit normal `(3,)`."""
        return np.cross(self.across, self.along)

    @property
    def pixel_area(self) -> float:
        """m^2."""
        return float((self.s[1] - self.s[0]) * (self.t[1] - self.t[0]))

    @property
    def area(self) -> float:
        """Area of the blood in the plane, m^2."""
        return float(self.inside.sum()) * self.pixel_area

    @property
    def points(self) -> Array:
        """All pixels `(nt * ns, 3)`, m."""
        places = self.centre + self.s[None, :, None] * self.across + self.t[:, None, None] * self.along
        return places.reshape(-1, 3)

    def sample(self, grid: geometry.Grid, field: ArrayLike, mask: ArrayLike) -> Array:
        """A field `(*lead, *shape)` on the pixels `(*lead, nt, ns)`, 0 outside the blood."""
        values, _ = sample_in_mask(grid, field, mask, self.points)
        return values.reshape(*values.shape[:-1], *self.inside.shape) * self.inside


def plane_section(
    grid: geometry.Grid,
    mask: ArrayLike,
    centre: ArrayLike,
    across: ArrayLike,
    along: ArrayLike,
    *,
    radius: float | None = None,
    pixel: float | None = None,
) -> PlaneSection:
    """The blood in the plane through `centre` spanned by `across` and `along`.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`, three-dimensional.
        centre: `(3,)`, m.
        across: `(3,)`, any length.
        along: `(3,)`; its part along `across` is taken out.
        radius: m; only the blood this near the centre. `None`: all of the plane.
        pixel: m; `None`: half of the least spacing.

    Raises:
        ValueError: the grid is not three-dimensional, or the directions span no plane.
    """
    if grid.dimension != 3:
        raise ValueError("plane_section: a plane recording is its own plane")
    middle, first, second = (np.asarray(vector, np.float64) for vector in (centre, across, along))
    first = first / np.linalg.norm(first)
    second = second - (second @ first) * first
    if not np.linalg.norm(second) > 1e-9:
        raise ValueError("plane_section: across and along span no plane")
    second = second / np.linalg.norm(second)
    corners = np.array(np.meshgrid(*zip(grid.origin, grid.upper, strict=True))).reshape(3, -1).T
    reach = float(np.linalg.norm(corners - middle, axis=1).max())
    step = 0.5 * min(grid.spacing) if pixel is None else pixel
    count = int(np.ceil((reach if radius is None else radius) / step))
    ticks = np.asarray(step * (np.arange(-count, count) + 0.5), np.float64)
    section = PlaneSection(middle, first, second, ticks, ticks, np.ones((2 * count, 2 * count), bool))
    _, share = sample_in_mask(grid, np.zeros(grid.shape), mask, section.points)
    inside = (share >= HALF).reshape(2 * count, 2 * count)
    if radius is not None:
        inside &= ticks[:, None] ** 2 + ticks[None, :] ** 2 <= radius**2
    t, s = _used(np.any(inside, axis=1)), _used(np.any(inside, axis=0))
    return PlaneSection(middle, first, second, ticks[s], ticks[t], inside[t, s])


def _used(pixels: NDArray[np.bool_]) -> slice:
    """From the first to the last pixel in use; at least two, so that a pixel has a size."""
    found = np.flatnonzero(pixels)
    first, last = (int(found[0]), int(found[-1])) if len(found) else (0, 1)
    first = min(first, len(pixels) - 2)
    return slice(first, max(last, first + 1) + 1)
