"""Between grids and particles: impose a velocity grid on particles, fetch particle velocities onto grid nodes.

Both are first-order moving least squares (MLS) with a compact weight, gathered by the receiving side only, so linear
fields are reproduced exactly wherever the neighbourhood is not degenerate (the thesis's symmetric form overshoots;
section 5.1 of the thesis asks for this cure).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from geometry import Grid

from .pairs.search import cross_pairs

# slopes are damped by this share of m0 R^2: a lopsided neighbourhood at a wall falls back to the plain average
_SLOPE_RIDGE = 1e-3
_CHUNK = 1 << 15


@dataclass(frozen=True)
class Fetched:
    """Velocities at query points: value (..., D) and whether particles covered the point (...)."""

    value: Tensor
    covered: Tensor


def wendland_weight(ratio: Tensor) -> Tensor:
    """(1 - s)^4 (1 + 4 s) for s = r / R in [0, 1), else 0 (Wendland C2)."""
    gap = (1.0 - ratio).clamp_min(0.0)
    return gap**4 * (1.0 + 4.0 * ratio)


def first_order_value(
    moment0: Tensor, moment1: Tensor, moment2: Tensor, value0: Tensor, value1: Tensor, radius: float
) -> Tensor:
    """MLS value at the origin from moments of a weight w over offsets s and values A.

    Args: sums of w (M,), w s (M, D), w s (x) s (M, D, D), w A (M, C), w s (x) A (M, D, C).
    Returns (M, C): a of the weighted fit A ~ a + s . b, with a ridge on b; 0 where the sum of w is 0.
    """
    dimension = moment1.shape[1]
    safe = torch.where(moment0 > 0, moment0, torch.ones_like(moment0))
    ridge = _SLOPE_RIDGE * radius * radius * safe
    eye = torch.eye(dimension, dtype=moment0.dtype, device=moment0.device)
    # eliminate a: (M2 - m1 m1'/m0 + ridge) b = m1A - m1 m0A / m0
    schur = moment2 - moment1[:, :, None] * moment1[:, None, :] / safe[:, None, None] + ridge[:, None, None] * eye
    right = value1 - moment1[:, :, None] * (value0 / safe[:, None])[:, None, :]
    slope = torch.linalg.solve(schur, right)
    mean = value0 / safe[:, None]
    value = mean - (moment1[:, :, None] * slope).sum(1) / safe[:, None]
    return torch.where(moment0[:, None] > 0, value, torch.zeros_like(value))


def fetch_at(
    points: Tensor, point_member: Tensor, position: Tensor, member: Tensor, value: Tensor, radius: float,
    *, widen: int = 2,
) -> Fetched:
    """Particle values at points by first-order MLS.

    Args:
        points: (M, D). point_member: (M,) int64.
        position: (N, D), member: (N,), value: (N, C) of the particles; same units as ``points``.
        radius: support of the weight. A point with fewer than D + 1 particles inside it is tried again with 1.5x the
            radius, ``widen`` times.

    Returns:
        ``Fetched`` with value (M, C) and covered (M,); uncovered points hold 0.
    """
    total = value.new_zeros((points.shape[0], value.shape[1]))
    covered = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    open_points = torch.arange(points.shape[0], device=points.device)
    for _ in range(widen + 1):
        if open_points.numel() == 0:
            break
        some, enough = _moving_least_squares(
            points[open_points], point_member[open_points], position, member, value, radius
        )
        total[open_points[enough]] = some[enough]
        covered[open_points[enough]] = True
        open_points = open_points[~enough]
        radius *= 1.5
    return Fetched(total, covered)


def _moving_least_squares(
    points: Tensor, point_member: Tensor, position: Tensor, member: Tensor, value: Tensor, radius: float
) -> tuple[Tensor, Tensor]:
    row, particle = cross_pairs(points, point_member, position, member, radius)
    offset = position.index_select(0, particle) - points.index_select(0, row)
    weight = wendland_weight(offset.norm(dim=1) / radius)
    first = weight[:, None] * offset
    carried = value.index_select(0, particle)
    count, dimension, channels = points.shape[0], points.shape[1], value.shape[1]

    def collect(part: Tensor) -> Tensor:
        flat = part.reshape(part.shape[0], -1)
        return flat.new_zeros((count, flat.shape[1])).index_add(0, row, flat).reshape(count, *part.shape[1:])

    moment0 = collect(weight)
    second = collect(first[:, :, None] * offset[:, None, :])
    value1 = collect(first[:, :, None] * carried[:, None, :])
    fitted = first_order_value(moment0, collect(first), second, collect(weight[:, None] * carried), value1, radius)
    neighbours = torch.bincount(row, minlength=count)
    assert value1.shape == (count, dimension, channels)
    return fitted, (neighbours > dimension) & (moment0 > 0)


def impose_at(
    points: Tensor, grid: Grid, field: Tensor, weight: Tensor, *, reach: float = 2.0
) -> tuple[Tensor, Tensor]:
    """Values of a grid field at points by MLS over the nodes within ``reach`` node spacings, weighted per node.

    Args:
        points: (N, D), m, or (N, D) in the grid's units.
        field: (C, *shape); weight: (*shape), not negative: mask times confidence or inverse variance.

    Returns:
        value (N, C), and the summed weight (N,) relative to full coverage with weight 1 (0: nothing known there).
    """
    values, shares = [], []
    for start in range(0, points.shape[0], _CHUNK):
        some, share = _impose_chunk(points[start : start + _CHUNK], grid, field, weight, reach)
        values.append(some)
        shares.append(share)
    if not values:
        return points.new_zeros((0, field.shape[0])), points.new_zeros(0)
    return torch.cat(values), torch.cat(shares)


def _impose_chunk(
    points: Tensor, grid: Grid, field: Tensor, weight: Tensor, reach: float
) -> tuple[Tensor, Tensor]:
    dimension, channels = points.shape[1], field.shape[0]
    located = grid.locate(points)
    index, offset = _block(located, grid, reach)
    ratio = offset.norm(dim=2) / reach
    kernel = wendland_weight(ratio) * (index >= 0)
    safe = index.clamp_min(0)
    w = kernel * weight.reshape(-1)[safe]
    carried = field.reshape(channels, -1)[:, safe].permute(1, 2, 0)  # (n, K, C)
    carried = torch.where(w[:, :, None] > 0, carried, torch.zeros_like(carried))  # NaN may stand where weight is 0
    first = w[:, :, None] * offset
    moment0 = w.sum(1)
    value = first_order_value(
        moment0, first.sum(1), first.transpose(1, 2) @ offset, (w[:, :, None] * carried).sum(1),
        first.transpose(1, 2) @ carried, reach,
    )
    full = _full_weight(dimension, reach)
    return value, moment0 / full


def _block(located: Tensor, grid: Grid, reach: float) -> tuple[Tensor, Tensor]:
    """Flat indices (n, K) of the nodes around each point (-1 outside the grid) and their offsets in nodes (n, K, D)."""
    half = int(reach + 0.999)
    steps = torch.arange(1 - half, half + 1, device=located.device)
    shifts = torch.cartesian_prod(*([steps] * located.shape[1]))
    node = torch.floor(located).to(torch.int64)[:, None, :] + shifts[None]
    counts = torch.tensor(grid.shape[::-1], device=located.device)
    inside = ((node >= 0) & (node < counts)).all(2)
    flat = torch.zeros_like(node[..., 0])
    for axis in range(located.shape[1] - 1, -1, -1):
        flat = flat * counts[axis] + node[..., axis]
    return torch.where(inside, flat, torch.full_like(flat, -1)), node.to(located.dtype) - located[:, None, :]


def _full_weight(dimension: int, reach: float) -> float:
    """Sum of the weights at a point in the middle of a complete grid: the kernel's integral over one node volume."""
    # integral of (1-s)^4 (1+4s) over the disc, the ball of radius R: pi R^2 / 7, 4 pi R^3 / 42 ... by Beta functions
    return {2: 3.141592653589793 / 7.0, 3: 2.0 * 3.141592653589793 / 21.0}[dimension] * reach**dimension


def fill_beyond(field: Tensor, mask: Tensor, grid: Grid, domain: object, layers: int = 3) -> Tensor:
    """Continue a field beyond its mask, so that interpolation near the edge mixes in nothing foreign.

    Behind a wall stands the wall's velocity (no slip); in an open channel, or where there are no walls, the mean of
    the known neighbours continues outward, layer by layer.

    Args:
        field: (B, D, *shape), m/s. mask: (*shape) bool. domain: gives ``sample`` and ``units`` (see ``Domain``).
    """
    known = mask.clone()
    filled = torch.where(mask, field, torch.zeros_like(field))
    for _ in range(layers):
        count, total = _neighbour_sums(known.to(field.dtype)[None, None]), _neighbour_sums(filled * known)
        fresh = ~known & (count[0, 0] > 0)
        filled = torch.where(fresh, total / count.clamp_min(1.0), filled)
        known = known | fresh
    if domain.walls is None:
        return filled
    beyond = torch.nonzero((known & ~mask).reshape(-1)).squeeze(1)
    points = grid.nodes(dtype=torch.float64, device=field.device)[beyond] / domain.units.length
    wall = domain.sample_at(points.to(field.dtype))
    solid = beyond[wall.distance < 0]
    flat = filled.reshape(*filled.shape[:2], -1).clone()
    flat[:, :, solid] = wall.velocity[wall.distance < 0].T * domain.units.speed
    return flat.reshape(filled.shape)


def _neighbour_sums(field: Tensor) -> Tensor:
    """Sum over the 2 D nearest nodes of (..., *shape); leading two axes are batch."""
    total = torch.zeros_like(field)
    for axis in range(2, field.ndim):
        length = field.shape[axis]
        total.narrow(axis, 1, length - 1).add_(field.narrow(axis, 0, length - 1))
        total.narrow(axis, 0, length - 1).add_(field.narrow(axis, 1, length - 1))
    return total
