"""Circulation of a contour, and of the blood in a plane.

    Gamma = closed integral of u . dl = integral of omega . n dA   (Stokes)                          [m^2/s]

`contour_circulation` takes the first form, trapezoids along a closed polygon; `plane_circulation` the second, with its
positive and negative parts apart, as two counter-rotating halves of a ring cancel in the sum.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import geometry

from .fields.sampling import PlaneSection, sample_in_mask

__all__ = ["PlaneCirculation", "contour_circulation", "plane_circulation"]

Array = NDArray[np.float64]


class PlaneCirculation(NamedTuple):
    """Circulation of a plane and of its parts that turn one way, each `(*batch)`, m^2/s."""

    net: Array
    positive: Array
    negative: Array


def contour_circulation(velocity: ArrayLike, grid: geometry.Grid, mask: ArrayLike, contour: ArrayLike) -> Array:
    """Circulation `(*batch)`, m^2/s, along the closed polygon `contour`, from the last point back to the first.

    Args:
        velocity: `(*batch, D, *shape)`, m/s.
        grid: the nodes.
        mask: bool `(*shape)`.
        contour: `(n, D)`, m, inside the blood.

    Raises:
        ValueError: the contour leaves the blood.
    """
    corners = np.asarray(contour, np.float64)
    values, share = sample_in_mask(grid, velocity, mask, corners)
    if (share <= 0).any():
        raise ValueError(f"contour_circulation: {int((share <= 0).sum())} points of the contour lie outside the blood")
    steps = np.roll(corners, -1, axis=0) - corners
    return np.einsum("...dn,nd->...", 0.5 * (values + np.roll(values, -1, axis=-1)), steps)


def plane_circulation(
    vorticity: ArrayLike, grid: geometry.Grid, mask: ArrayLike, section: PlaneSection
) -> PlaneCirculation:
    """Circulation of the blood in a plane, from `vorticity` `(*batch, 3, *shape)`, 1/s, along its normal."""
    sampled = section.sample(grid, vorticity, mask)
    through = np.einsum("...dts,d->...ts", sampled, section.normal) * section.pixel_area
    positive, negative = np.maximum(through, 0).sum((-2, -1)), np.minimum(through, 0).sum((-2, -1))
    return PlaneCirculation(positive + negative, positive, negative)
