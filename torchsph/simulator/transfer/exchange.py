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
# volumes of particles, relative to that of their spacing, between which they follow what comes in: sums over particles
# of very different sizes are rough, and evening out moves what is missing
_SIZES = (0.5, 2.0)


class Exchange:
    """Rates at which volume comes in through a plane, on a grid.

    Args:
        grid: the nodes, m.
        fields: (B, D, *shape), m/s, of each member or one for all, known on the mask.
        mask: (*shape) bool.
        units: of the particles.
        spacing: m, of the particles.
        wanted: (members,), internal, what comes in per time within the walls together; None: what the fields have.
    """

    def __init__(
        self, grid: Grid, fields: Tensor, mask: Tensor, units: Units, spacing: float, wanted: Tensor | None
    ) -> None:
        steps = tuple(grid.spacing)
        rough = torch.stack([masked_gradient(one, mask, steps).diagonal().sum(-1) for one in fields])
        even = masked_blur(rough, mask, fwhm_to_deviation(_WIDTH * spacing), steps)
        self.grid, self.units, self.wanted = grid, units, wanted
        self._rate = fill_beyond(even[:, None], mask, grid, None)[:, 0] * units.time

    def carried(self, particles: Particles) -> Particles:
        """Particles with the rates at their places; those outside the walls have none.

        A constant for each member is added, so that together they take in what ``wanted`` says: heavy particles gather
        where much comes in, and would let the whole grow.
        """
        inside = particles.inside
        sampled = self.grid.sample(self._rate, particles.position * self.units.length)
        own = sampled[0] if len(sampled) == 1 else sampled.gather(0, particles.member[None])[0]
        rate = torch.where(inside, own.to(particles.mass), 0.0)
        found = particles.changed(exchange=rate)
        if self.wanted is None:
            return found
        area = particles.per_member(torch.where(inside, particles.mass, 0.0), "sum").clamp_min(1e-6)
        missing = ((self.wanted - exchanged(found)) / area).index_select(0, particles.member)
        return found.changed(exchange=torch.where(inside, rate + missing, 0.0))


def exchanged(particles: Particles) -> Tensor:
    """Volume per time, internal, that comes in through the plane within the walls, (members,)."""
    if particles.exchange is None:
        return torch.zeros(particles.members, dtype=particles.mass.dtype, device=particles.mass.device)
    passing = particles.mass * particles.exchange
    return particles.per_member(torch.where(particles.inside, passing, torch.zeros_like(passing)), "sum")


def grown(particles: Particles, step: Tensor) -> Particles:
    """Particles with what has come in through the plane in a step (N,), internal."""
    assert particles.exchange is not None
    mass = particles.mass * torch.where(particles.inside, particles.exchange * step, 0.0).exp()
    within = mass.clamp(*_SIZES)
    # one that has been larger or smaller all along is let back, but goes no farther
    closer = (mass - within).abs() < (particles.mass - particles.mass.clamp(*_SIZES)).abs()
    return particles.changed(mass=torch.where(closer, mass, within))
