"""A velocity grid freed of its divergence by the smallest change, for output."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg

from torchsph.evaluation.divergence import interior_nodes

# a result that misses the reduction asked for by more than this factor is not taken
_ENOUGH = 3.0


@dataclass(frozen=True)
class Cleaned:
    """A field (D, *shape) and how it came about.

    Attributes:
        left: RMS divergence over that of the field before; 1: the field is the one given. converged: whether conjugate
            gradients got to the reduction asked for.
    """

    velocity: np.ndarray
    left: float
    converged: bool


def without_divergence(
    velocity: np.ndarray,
    mask: np.ndarray,
    spacing: tuple[float, ...],
    *,
    reduction: float = 0.1,
    iterations: int = 2000,
) -> Cleaned:
    """The field (D, *shape) nearest to ``velocity`` whose central differences have next to no divergence.

    Particles know the divergence of their own neighbourhoods; fetched onto nodes they leave a remainder of the size of
    the transfer's error. Minimal in the sum of squares, v - B' (B B')^-1 B v with B the divergence at the nodes of
    ``mask`` whose 2 D neighbours lie in it; solved by conjugate gradients until ``reduction`` of it is left or for so
    many ``iterations``. Where these end early with more than ``_ENOUGH`` times that, the field stays as it was.
    """
    rows = _divergence(mask, spacing)
    inside = velocity[:, mask].astype(np.float64).reshape(-1)
    before = rows @ inside
    size = float(np.linalg.norm(before))
    if size == 0.0:
        return Cleaned(velocity.copy(), 0.0, True)
    pressure, flag = cg(rows @ rows.T, before, rtol=reduction, maxiter=iterations)
    changed = inside - rows.T @ pressure
    left = float(np.linalg.norm(rows @ changed)) / size
    if not left <= _ENOUGH * reduction:  # not a number counts as well
        return Cleaned(velocity.copy(), 1.0, False)
    out = np.zeros_like(velocity)
    out[:, mask] = changed.reshape(len(velocity), -1)
    return Cleaned(out, left, flag == 0)


def _divergence(mask: np.ndarray, spacing: tuple[float, ...]) -> sparse.csr_matrix:
    """Rows: nodes with all neighbours in the mask; columns: component-major velocities at the nodes of the mask."""
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(mask.sum())
    where = np.argwhere(interior_nodes(mask))
    count, total = len(where), int(mask.sum())
    index, column, value = [], [], []
    for component, step in enumerate(spacing):
        axis = mask.ndim - 1 - component
        for way in (1, -1):
            place = where.copy()
            place[:, axis] += way
            index.append(np.arange(count))
            column.append(component * total + number[tuple(place.T)])
            value.append(np.full(count, way / (2.0 * step)))
    shape = (count, len(spacing) * total)
    return sparse.csr_matrix((np.concatenate(value), (np.concatenate(index), np.concatenate(column))), shape=shape)
