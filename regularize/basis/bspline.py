"""Cardinal (uniform) B-splines of degree 1 to 5 on one knot interval.

The pieces are polynomials of the local coordinate t in [0, 1); on each interval degree + 1 basis functions
are non-zero. Their coefficients follow from the Cox-de Boor recursion (C. de Boor, A Practical Guide to
Splines, 1978; Grønli 2017, eq. 2.37), carried out once in exact rational arithmetic. For degree 3 they are the
cubic cardinal B-spline of Grønli 2017, eq. 2.39.
"""

from fractions import Fraction
from functools import lru_cache

import numpy as np
import torch

from regularize.arguments import Rule, between, checked
from regularize.errors import InvalidInput

DEGREES = (1, 2, 3, 4, 5)
MOST_DISTANCE = 1e6  # of a place in its interval, whose fifth power float32 still holds
NEAR = Rule(
    f"floating point, finite and within {MOST_DISTANCE:g} of 0",
    lambda t: t.is_floating_point() and bool((t.abs() <= MOST_DISTANCE).all()),
)
MOST_ORDER = 6  # of derivatives: one more than the highest degree has is 0


def _times_linear(poly: list[Fraction], constant: Fraction, slope: Fraction) -> list[Fraction]:
    """(constant + slope t) * poly, coefficients in increasing powers."""
    out = [Fraction(0)] * (len(poly) + 1)
    for power, value in enumerate(poly):
        out[power] += constant * value
        out[power + 1] += slope * value
    return out


@lru_cache
def pieces(degree: int) -> np.ndarray:
    """(degree + 1, degree + 1) float64: row i holds the powers 1, t, t^2 ... of the i-th non-zero function.

    Function i is the one whose support starts degree - i intervals before the current one, so that i runs
    with the coefficient index.
    """
    if degree not in DEGREES:
        raise InvalidInput(f"degree is {degree}: a B-spline degree must be one of {DEGREES}")
    rows = [[Fraction(1)]]
    for p in range(1, degree + 1):
        # Uniform knots: B_i^p(t) = ((t + p - i) B_{i-1}^{p-1}(t) + (i + 1 - t) B_i^{p-1}(t)) / p.
        new = []
        for i in range(p + 1):
            total = [Fraction(0)] * (p + 1)
            if i > 0:
                left = _times_linear(rows[i - 1], Fraction(p - i, p), Fraction(1, p))
                total = [a + b for a, b in zip(total, left, strict=True)]
            if i < p:
                right = _times_linear(rows[i], Fraction(i + 1, p), Fraction(-1, p))
                total = [a + b for a, b in zip(total, right, strict=True)]
            new.append(total)
        rows = new
    table = np.array([[float(value) for value in row] for row in rows])
    table.setflags(write=False)
    return table


@lru_cache
def derivative_pieces(degree: int, order: int) -> np.ndarray:
    """Like :func:`pieces`, for the order-th derivative with respect to t."""
    table = pieces(degree)
    for _ in range(order):
        powers = np.arange(1, table.shape[1])
        table = table[:, 1:] * powers if table.shape[1] > 1 else np.zeros((len(table), 1))
    return table


@checked(t=NEAR, degree=between(DEGREES[0], DEGREES[-1]), order=between(0, MOST_ORDER))
def basis(t: torch.Tensor, degree: int, order: int = 0) -> torch.Tensor:
    """Values (..., degree + 1) of the non-zero functions, or of their order-th derivative, at t (...).

    Raises:
        InvalidInput: t is no tensor of finite real numbers, or there is no such degree or derivative.
    """
    return basis_at(t, degree, order)


def basis_at(t: torch.Tensor, degree: int, order: int) -> torch.Tensor:
    """`basis`, of arguments that are known to be sound."""
    table = torch.as_tensor(derivative_pieces(degree, order).copy(), dtype=t.dtype, device=t.device)
    powers = torch.stack([t**k for k in range(table.shape[1])], dim=-1)
    return powers @ table.T


@lru_cache
def interval_gram(degree: int, first: int, second: int) -> np.ndarray:
    """(degree + 1, degree + 1): exact integral over one interval of the products B_i^(first) B_j^(second)."""
    nodes, weights = np.polynomial.legendre.leggauss(degree + 1)
    t = torch.as_tensor((nodes + 1) / 2)
    a = basis_at(t, degree, first).numpy()
    b = basis_at(t, degree, second).numpy()
    return np.einsum("q,qi,qj->ij", weights / 2, a, b)
