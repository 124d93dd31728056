"""From particles to grids: velocities at the nodes by first-order moving least squares."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.interface import Backend
from torchsph.pairs.moving_least_squares import Fetched, fetch_at

from ..state.particles import Particles
from ..state.units import Units

# support radius of the fetching weight, in spacings
FETCH_RADIUS = 2.0


def fetch_on_grid(
    particles: Particles,
    grid: Grid,
    mask: Tensor,
    units: Units,
    backend: Backend,
    period: Tensor | None,
    nearest_fluid: Callable[[Tensor], Tensor] | None = None,
) -> Fetched:
    """Velocities of all members at some nodes of a grid.

    Args:
        particles: the particles; their confidence weighs them.
        grid: the nodes, m.
        mask: (*shape) bool, where velocities are asked for.
        units: internal units.
        backend: for the sums over neighbours.
        period: (D,), internal, of the periodic box, or None.
        nearest_fluid: gives for points (n, D), internal, those where there is fluid. A node beyond the walls gets what
            flows before them: a slope carried on from one side is wrong there by more than the velocity itself.

    Returns:
        ``value`` (members, D, *shape), m/s, 0 where nothing is known, and ``covered`` (members, *shape) bool.
    """
    members, dimension = particles.members, grid.dimension
    node = torch.nonzero(mask.reshape(-1)).squeeze(1)
    points = grid.nodes(dtype=torch.float64, device=particles.position.device)[node] / units.length
    points = points.to(particles.position.dtype)
    if nearest_fluid is not None:
        points = nearest_fluid(points)
    points = points.repeat(members, 1)
    owner = torch.arange(members, device=particles.member.device).repeat_interleave(len(node))
    found = fetch_at(
        backend,
        points,
        owner,
        particles.position,
        particles.member,
        particles.velocity * units.speed,
        FETCH_RADIUS,
        period=period,
        weight=particles.confidence,
    )
    value = particles.velocity.new_zeros((members, dimension, grid.size))
    covered = torch.zeros((members, grid.size), dtype=torch.bool, device=particles.member.device)
    value[:, :, node] = found.value.reshape(members, len(node), dimension).transpose(1, 2)
    covered[:, node] = found.covered.reshape(members, len(node))
    return Fetched(value.reshape(members, dimension, *grid.shape), covered.reshape(members, *grid.shape))
