"""The order of a file's axes that leaves its velocity the least divergence, for files that do not say it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.grids.grid import Grid
from geometry.recordings.field_checks import FACTOR, derivative_products

from .assemble import Fields, assemble
from .field_map import FieldMap
from .source import FormatError, Source

ORDERS = ("zyx", "xyz", "yxz", "zxy", "xzy", "yzx")


def in_best_order(source: Source, said: FieldMap) -> tuple[Fields, str]:
    """The fields of a file, read once, in the order of axes of least divergence, and that order.

    The derivatives along the stored axes and their products give the divergence of every order; spacings belong to x,
    y, z and so do components, whatever axis they turn out to be.

    Args:
        source: of three-dimensional arrays that do not say where they lie.
        said: the rest of what the file does not say.

    Raises:
        FormatError: the file says itself how its axes lie, or too little is measured to tell.
    """
    if source.affine is not None:
        raise FormatError(f"{source.path}: says itself how its axes lie; leave --axes auto out, or name the order")
    stored = assemble(source, replace(said, axes="zyx"))
    known = np.isfinite(stored.velocity).all(axis=1)
    inside = known if stored.mask is None else known & stored.mask
    products = derivative_products(stored.velocity, inside, (1.0, 1.0, 1.0))
    if products is None:
        raise FormatError(f"{source.path}: too little is measured to find the order of axes; say it (--axes zyx)")
    scores = {axes: _divergence(products, axes, stored.grid.spacing) for axes in ORDERS}
    axes = min(scores, key=lambda one: scores[one])
    if scores["zyx"] <= FACTOR * scores[axes]:
        axes = "zyx"
    rest = ", ".join(f"{one} {score:.2g}" for one, score in scores.items() if one != axes)
    note = f"axes taken as {axes}: divergence {scores[axes]:.2g} of the gradient ({rest})"
    return replace(_reordered(stored, axes), notes=[*stored.notes, note]), axes


def _divergence(products: np.ndarray, axes: str, spacing: tuple[float, ...]) -> float:
    """The RMS of the divergence relative to that of the gradient, for stored axes of those letters.

    Args:
        products: (3, 3, 3, 3), of the differences of components along the axes that `zyx` would call x, y, z.
        axes: the letters, in array order.
        spacing: along x, y, z.
    """
    place = ["zyx"[axes.index(letter)] for letter in "xyz"]  # what `zyx` calls the axis of x, y, z
    along = ["xyz".index(letter) for letter in place]
    step = np.asarray(spacing)
    square = sum(products[a, along[a], b, along[b]] / (step[a] * step[b]) for a in range(3) for b in range(3))
    total = sum(products[c, along[a], c, along[a]] / step[a] ** 2 for c in range(3) for a in range(3))
    return float(np.sqrt(max(square, 0.0) / total)) if total > 0 else 1.0


def _reordered(fields: Fields, axes: str) -> Fields:
    """Fields that were read as `zyx`, taken as of other axes; views, no copies."""
    if axes == "zyx":
        return fields
    order = [axes.index(letter) for letter in "zyx"]

    def turned(values: np.ndarray | None) -> np.ndarray | None:
        if values is None:
            return None
        lead = values.ndim - 3
        return np.transpose(values, [*range(lead), *(lead + axis for axis in order)])

    grid = fields.grid
    shape = tuple(grid.shape[axis] for axis in order)
    velocity = turned(fields.velocity)
    assert velocity is not None
    return replace(
        fields,
        grid=Grid(grid.origin, grid.spacing, shape),
        velocity=velocity,
        mask=turned(fields.mask),
        weight=turned(fields.weight),
        sigma=turned(fields.sigma),
    )
