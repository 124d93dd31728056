"""From grids to particles: velocities at points by moving least squares over the nodes around, and beyond a mask.

First order with a compact weight, gathered by the receiving side only, so that linear fields are reproduced exactly
wherever the neighbourhood is not degenerate (the symmetric form of Grønli 2017 overshoots; sec. 5.1 there asks for this
cure). The way back is ``pairs.moving_least_squares.fetch_at``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.moving_least_squares import first_order_value

_CHUNK = 1 << 15
# summed weight, relative to full coverage, below which nothing is known
_LEAST_COVERAGE = 1e-6


def wendland_weight(ratio: Tensor) -> Tensor:
    """(1 - s)^4 (1 + 4 s) for s = r / R in [0, 1), else 0 (Wendland C2)."""
    gap = (1.0 - ratio).clamp_min(0.0)
    return gap**4 * (1.0 + 4.0 * ratio)


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
    values, coverage = [], []
    for start in range(0, points.shape[0], _CHUNK):
        value, weights = _impose_chunk(points[start : start + _CHUNK], grid, field, weight, reach)
        values.append(value)
        coverage.append(weights)
    if not values:
        return points.new_zeros((0, field.shape[0])), points.new_zeros(0)
    return torch.cat(values), torch.cat(coverage)


def _impose_chunk(points: Tensor, grid: Grid, field: Tensor, weight: Tensor, reach: float) -> tuple[Tensor, Tensor]:
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
        moment0,
        first.sum(1),
        first.transpose(1, 2) @ offset,
        (w[:, :, None] * carried).sum(1),
        first.transpose(1, 2) @ carried,
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


def pulled(points: Tensor, velocity: Tensor, grid: Grid, target: Tensor, gain: Tensor, weight: Tensor) -> Tensor:
    """Velocity (N, D) pulled towards a grid field where it is known; see ``particle_filter``."""
    value, covered = impose_at(points, grid, torch.cat([target, gain[None]]), weight)
    # at the very end of a node's reach the weights underflow, and their fit is no number
    known = (covered > _LEAST_COVERAGE)[:, None]
    moved = velocity + value[:, -1:].clamp(0.0, 1.0) * (value[:, :-1] - velocity)
    return torch.where(known, moved, velocity)


def fill_beyond(
    field: Tensor,
    mask: Tensor,
    grid: Grid,
    walls: Callable[[Tensor], tuple[Tensor, Tensor]] | None,
    layers: int = 3,
) -> Tensor:
    """Continue a field beyond its mask, so that interpolation near the edge mixes in nothing foreign.

    Behind a wall stands the wall's velocity (no slip); in an open channel, or where there are no walls, the mean of
    the known neighbours continues outward, layer by layer.

    Args:
        field: (B, D, *shape), m/s.
        mask: (*shape) bool, where it is known.
        grid: the nodes, m.
        walls: gives distance (n,), positive in the fluid, and velocity (n, D), m/s, of the walls at points (n, D)
            float64, m; None: there are none.
        layers: nodes beyond the mask that are filled.
    """
    known = mask.clone()
    filled = torch.where(mask, field, torch.zeros_like(field))
    for _ in range(layers):
        count, total = _neighbour_sums(known.to(field.dtype)[None, None]), _neighbour_sums(filled * known)
        fresh = ~known & (count[0, 0] > 0)
        filled = torch.where(fresh, total / count.clamp_min(1.0), filled)
        known = known | fresh
    if walls is None:
        return filled
    beyond = torch.nonzero((known & ~mask).reshape(-1)).squeeze(1)
    distance, velocity = walls(grid.nodes(dtype=torch.float64, device=field.device)[beyond])
    flat = filled.reshape(*filled.shape[:2], -1).clone()
    flat[:, :, beyond[distance < 0]] = velocity[distance < 0].T
    return flat.reshape(filled.shape)


def _neighbour_sums(field: Tensor) -> Tensor:
    """Sum over the 2 D nearest nodes of (..., *shape); leading two axes are batch."""
    total = torch.zeros_like(field)
    for axis in range(2, field.ndim):
        length = field.shape[axis]
        total.narrow(axis, 1, length - 1).add_(field.narrow(axis, 0, length - 1))
        total.narrow(axis, 0, length - 1).add_(field.narrow(axis, 1, length - 1))
    return total
