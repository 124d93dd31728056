"""Integrals of squared derivatives over one knot cell, as row factors.

Integrating the polynomial pieces exactly makes the penalties independent of where samples happen to lie
and of how fine the knots are (P. Eilers and B. Marx's difference penalties, Stat. Sci. 11, 1996, are their
limit on fine knots). All derivatives are per metre and the integrals in m^A.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import numpy as np
import torch

from regularize.basis.bspline import interval_gram
from regularize.basis.knots import Knots
from regularize.errors import InvalidInput

KEPT = 64  # integrals, of 32 kB each for cubic splines in space


def product_gram(knots: Knots, first: Sequence[int], second: Sequence[int]) -> np.ndarray:
    """(L, L): integral over a cell of d^first B_i times d^second B_j; orders per axis, x first."""
    return _product(knots.spacing, knots.degree, tuple(first), tuple(second))


@lru_cache(maxsize=KEPT)  # frames share their knot distances
def _product(spacing: tuple[float, ...], degree: int, first: tuple[int, ...], second: tuple[int, ...]) -> np.ndarray:
    gram: np.ndarray = np.ones((1, 1))
    for axis in reversed(range(len(spacing))):
        h = spacing[axis]
        one = interval_gram(degree, first[axis], second[axis]) * h ** (1 - first[axis] - second[axis])
        gram = np.kron(gram, one)
    gram.flags.writeable = False
    return gram


def curvature_gram(knots: Knots, axes: Sequence[int], order: int = 2) -> np.ndarray:
    """(L, L): integral of the squared derivatives of an order, for 2 |grad grad f|^2, over the listed axes.

    All derivatives are summed, mixed ones as often as they occur: the integral is that of the isotropic semi-norm of
    thin-plate splines (J. Duchon, 1977). InvalidInput where the spline's own derivative of that order vanishes.
    """
    if knots.degree < order:
        raise InvalidInput(f"derivatives of order {order} need degree >= {order}, not {knots.degree}")
    total = np.zeros((knots.local_size,) * 2)
    for along in product(axes, repeat=order):
        orders = [along.count(a) for a in range(knots.axes)]
        total += product_gram(knots, orders, orders)
    return total


def divergence_gram(knots: Knots, components: int) -> np.ndarray:
    """(L C, L C), node-major: integral of (div v)^2 over a cell."""
    size = knots.local_size
    total = np.zeros((size, components, size, components))
    for k in range(components):
        for m in range(components):
            first = [int(a == k) for a in range(knots.axes)]
            second = [int(a == m) for a in range(knots.axes)]
            total[:, k, :, m] = product_gram(knots, first, second)
    return total.reshape(size * components, size * components)


def row_factor(gram: np.ndarray, components: int | None = None) -> torch.Tensor:
    """Rows F with F'F = gram, (r, L) or, with ``components``, (r, L, C); null directions are left out."""
    values, vectors = np.linalg.eigh(gram)
    keep = values > 1e-13 * values[-1]
    factor = (vectors[:, keep] * np.sqrt(values[keep])).T
    if components is not None:
        factor = factor.reshape(len(factor), -1, components)
    return torch.from_numpy(np.ascontiguousarray(factor))
