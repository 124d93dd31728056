"""The energy of particles, and its unit."""

from __future__ import annotations

from torch import Tensor

from torchsph.pairs.vectors import square_length

from .particles import Particles
from .units import Units


def energy_unit(units: Units, density: float, dimension: int) -> float:
    """J (in a plane J/m) per internal energy, which counts masses in those of a spacing^D of fluid at rest density."""
    return density * units.length**dimension * units.speed**2


def carried_energy(particles: Particles, pressure: Tensor) -> Tensor:
    """What particles carry through an opening: kinetic energy and the work p V of the pressure (N,), internal."""
    per_mass = 0.5 * square_length(particles.velocity) + pressure / (1.0 + particles.deviation)
    return (particles.mass * per_mass).double()
