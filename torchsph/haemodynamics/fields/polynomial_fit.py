"""Derivatives at scattered places by moving least squares (Lancaster & Salkauskas 1981).

Around each place a polynomial is fitted to the samples near it, with Gaussian weights of their distance; its
derivatives there are linear in the samples, and this file finds the coefficients.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

__all__ = ["Coefficients", "derivative_coefficients"]

Array = NDArray[np.float64]

REACH = 2.3
"""Samples farther than this, in spacings, do not enter a fit: a full neighbourhood has 57 nodes."""

WIDTH = 1.1
"""Gaussian width of the weights, in spacings: the next node weighs .44, one two spacings away .04."""

DETERMINED = 1e-4
"""Least ratio of the eigenvalues of the normal equations, lengths in spacings, that counts as determined."""

AT_ONCE = 4096
"""Places fitted together: bounds the memory."""


class Coefficients(NamedTuple):
    """What the samples of each place weigh; a sample number of -1 stands for none and weighs 0."""

    number: NDArray[np.int64]  # (places, k)
    value: Array  # (places, k): of the field itself, 1
    gradient: Array  # (places, k, D): 1/m
    laplacian: Array  # (places, k): 1/m^2
    rank: NDArray[np.int64]  # (places,): 2 quadratic, 1 linear, 0 not all directions are determined


def derivative_coefficients(places: Array, samples: Array, spacing: Array, neighbours: int = 64) -> Coefficients:
    """Coefficients of the value, the gradient and the Laplacian at `places` from values at `samples`.

    Args:
        places: `(m, D)`, m.
        samples: `(n, D)`, m.
        spacing: `(D,)`, m, the typical distance of samples along each axis.
        neighbours: nearest samples that may enter a fit.
    """
    tree = cKDTree(samples / spacing)
    parts = [
        _fit(places[start : start + AT_ONCE], samples, spacing, tree, min(neighbours, len(samples)))
        for start in range(0, max(len(places), 1), AT_ONCE)
    ]
    return Coefficients(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _fit(places: Array, samples: Array, spacing: Array, tree: cKDTree, neighbours: int) -> Coefficients:
    distance, number = tree.query(places / spacing, k=neighbours, distance_upper_bound=REACH)
    distance, number = (np.reshape(found, (len(places), -1)) for found in (distance, number))
    near = np.isfinite(distance)
    number = np.where(near, number, -1)
    offset = np.where(near[..., None], (samples[number] - places[:, None]) / spacing, 0.0)
    weight = np.where(near, np.exp(-((np.where(near, distance, 0.0) / WIDTH) ** 2)), 0.0)
    columns = _monomials(offset)
    linear = offset.shape[2] + 1
    rank = np.zeros(len(places), np.int64)
    solution = _solve(columns[..., :linear], weight, pseudo=True)[0]  # least norm: 0 along unknown directions
    result = np.zeros((len(places), columns.shape[2], near.shape[1]))
    result[:, :linear] = solution
    for order, count in ((1, linear), (2, columns.shape[2])):
        solution, determined = _solve(columns[..., :count], weight)
        result[determined, :count] = solution[determined]
        rank[determined] = order
    dimension = offset.shape[2]
    gradient = np.moveaxis(result[:, 1:linear], 1, 2) / spacing
    # the quadratic part is 1/2 a_xx x^2 + ... + a_xy x y + ...: the pure ones come first
    laplacian = np.einsum("mdk,d->mk", result[:, linear : linear + dimension], spacing**-2.0)
    return Coefficients(number, result[:, 0], gradient, laplacian, rank)


def _monomials(x: Array) -> Array:
    """1, x_i, x_i^2 / 2, x_i x_j at offsets `(m, k, D)`: `(m, k, columns)`."""
    dimension = x.shape[-1]
    pairs = [(i, j) for i in range(dimension) for j in range(i + 1, dimension)]
    mixed = [x[..., i] * x[..., j] for i, j in pairs]
    return np.concatenate([np.ones_like(x[..., :1]), x, 0.5 * x**2, np.stack(mixed, -1)], axis=-1)


def _solve(columns: Array, weight: Array, pseudo: bool = False) -> tuple[Array, NDArray[np.bool_]]:
    """(A'WA)^-1 A'W `(m, columns, k)`, and where the normal equations are determined `(m,)`."""
    weighted = columns * weight[..., None]
    normal = np.swapaxes(columns, 1, 2) @ weighted
    values, vectors = np.linalg.eigh(normal)
    large = values > DETERMINED * values[:, -1:]
    inverse = np.where(large, 1 / np.where(large, values, 1.0), 0.0)
    determined = np.all(large, axis=1)
    if not pseudo:
        inverse = inverse * determined[:, None]
    solution = (vectors * inverse[:, None, :]) @ (np.swapaxes(vectors, 1, 2) @ np.swapaxes(weighted, 1, 2))
    return solution, determined
