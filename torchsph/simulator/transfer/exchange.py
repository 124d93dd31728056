"""What passes through a plane that is cut out of a flow in space: the divergence that its velocities have in it.

A flow in space without divergence has one in a plane, minus the rate at which its component across changes across. No
wall tells it; the field that is imposed does. It stays where it is until the next field is imposed; particles take in
volume at that rate, and the pressure leaves it alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geometry import Grid
from geometry.grids.fields import fwhm_to_deviation, masked_blur, masked_gradient

from ..state.particles import Particles
from ..state.units import Units
from .imposing import fill_beyond

# FWHM of the average over the divergence on the grid, in particle spacings: finer ones are the transfer's own
_WIDTH = 2.0


class Exchange:
    """Rates at which volume comes in through a plane, on a grid.

    Args:
        grid: the nodes, m.
        fields: (B, D, *shape), m/s, of each member or one for all, known on the mask.
        mask: (*shape) bool.
        units: of the particles.
        spacing: m, of the particles.
    """

    def __init__(self, grid: Grid, fields: Tensor, mask: Tensor, units: Units, spacing: float) -> None:
        steps = tuple(grid.spacing)
        rough = torch.stack([masked_gradient(one, mask, steps).diagonal().sum(-1) for one in fields])
        even = masked_blur(rough, mask, fwhm_to_deviation(_WIDTH * spacing), steps)
        self.grid, self.units = grid, units
        self._rate = fill_beyond(even[:, None], mask, grid, None)[:, 0] * units.time

    def carried(self, particles: Particles) -> Particles:
        """Particles with the rates at their places; those outside the walls have none."""
        sampled = self.grid.sample(self._rate, particles.position * self.units.length)
        own = sampled[0] if len(sampled) == 1 else sampled.gather(0, particles.member[None])[0]
        nothing = torch.zeros_like(particles.mass)
        return particles.changed(exchange=torch.where(particles.inside, own.to(nothing), nothing))

    def level(self, particles: Particles, wanted: Tensor) -> None:
        """Add a constant for each member, so that together (members,), internal, comes in as is wanted."""
        mass = torch.where(particles.inside, particles.mass, torch.zeros_like(particles.mass))
        missing = (wanted - exchanged(self.carried(particles))) / particles.per_member(mass, "sum").clamp_min(1e-6)
        self._rate = self._rate + missing.reshape(-1, *[1] * self.grid.dimension)


def exchanged(particles: Particles) -> Tensor:
    """Volume per time, internal, that comes in through the plane within the walls, (members,)."""
    if particles.exchange is None:
        return torch.zeros(particles.members, dtype=particles.mass.dtype, device=particles.mass.device)
    passing = particles.mass * particles.exchange
    return particles.per_member(torch.where(particles.inside, passing, torch.zeros_like(passing)), "sum")
