"""First-order moving least squares (MLS): values at points from those of the particles around.

Gathered by the receiving side only, so that linear fields are reproduced exactly wherever the neighbourhood is not
degenerate.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .interface import Backend, Support
from .smoothing_kernels import kernel

# neighbours that lie nearly in a plane, or on a line, say nothing of the slope across it: below this ratio of the
# spread's determinant to that of a round spread of the same size, the plain average is taken
_LEAST_ROUNDNESS = 1e-3


@dataclass(frozen=True)
class Fetched:
    """Velocities at query points: value (..., D) and whether particles covered the point (...)."""

    value: Tensor
    covered: Tensor


def first_order_value(moment0: Tensor, moment1: Tensor, moment2: Tensor, value0: Tensor, value1: Tensor) -> Tensor:
    """MLS value at the origin from moments of a weight w over offsets s and values A.

    Args: sums of w (M,), w s (M, D), w s (x) s (M, D, D), w A (M, C), w s (x) A (M, D, C).
    Returns (M, C): a of the weighted fit A ~ a + s . b; 0 where the sum of w is 0.
    """
    safe = torch.where(moment0 > 0, moment0, torch.ones_like(moment0))
    mean = value0 / safe[:, None]
    # eliminate a: (M2 - m1 m1' / m0) b = m1A - m1 m0A / m0
    spread = moment2 - moment1[:, :, None] * moment1[:, None, :] / safe[:, None, None]
    right = value1 - moment1[:, :, None] * mean[:, None, :]
    slope = solve_small(spread, right)
    value = mean - (moment1[:, :, None] * slope).sum(1) / safe[:, None]
    return torch.where(moment0[:, None] > 0, value, torch.zeros_like(value))


def solve_small(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve (M, D, D) x = (M, D, C) for D = 2, 3 by cofactors (a batched LAPACK call costs ten times as much).

    Symmetric, not negative; where the matrix is nearly singular (``_LEAST_ROUNDNESS``) the answer is 0.
    """
    dimension = matrix.shape[-1]
    if dimension == 2:
        a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
        rows = [torch.stack([d, -b], 1), torch.stack([-c, a], 1)]
        determinant = a * d - b * c
    else:
        x, y, z = matrix.unbind(2)  # columns
        rows = [torch.linalg.cross(y, z), torch.linalg.cross(z, x), torch.linalg.cross(x, y)]
        determinant = (x * rows[0]).sum(1)
    round_one = (matrix.diagonal(dim1=1, dim2=2).sum(1) / dimension) ** dimension
    regular = determinant > _LEAST_ROUNDNESS * round_one
    inverse = torch.where(regular, 1.0 / torch.where(regular, determinant, torch.ones_like(determinant)), 0.0)
    return torch.stack(rows, 1) @ right * inverse[:, None, None]


def fetch_at(
    backend: Backend,
    points: Tensor,
    point_member: Tensor,
    position: Tensor,
    member: Tensor,
    value: Tensor,
    radius: float,
    *,
    period: Tensor | None = None,
    widen: int = 2,
    weight: Tensor | None = None,
) -> Fetched:
    """Particle values at points by first-order MLS.

    Args:
        points: (M, D). point_member: (M,) int64.
        position: (N, D), member: (N,), value: (N, C) of the particles; same units as ``points``.
        radius: support of the weight. A point with fewer than D + 1 particles inside it is tried again with 1.5x the
            radius, ``widen`` times.
        weight: (N,), not negative, of the particles; None: all alike.

    Returns:
        ``Fetched`` with value (M, C) and covered (M,); uncovered points hold 0.
    """
    dimension = points.shape[1]
    total = value.new_zeros((points.shape[0], value.shape[1]))
    covered = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    open_points = torch.arange(points.shape[0], device=points.device)
    for _ in range(widen + 1):
        if open_points.numel() == 0:
            break
        support = Support(kernel("wendland_c2"), 0.5 * radius, dimension)
        m = backend.interpolate(
            position,
            member,
            value,
            support,
            points[open_points],
            point_member[open_points],
            period=period,
            weight=weight,
        )
        some = first_order_value(m.value, m.first, m.second, m.field, m.field_first)
        enough = m.count > dimension
        total[open_points[enough]] = some[enough]
        covered[open_points[enough]] = True
        open_points = open_points[~enough]
        radius *= 1.5
    return Fetched(total, covered)
