"""The order of a weakly compressible step: what is taken where, and what it changes.

A time scheme is a function of the sums; shifting and position XSPH are displacements per step in all of them: they even
the particles out and have no order.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from torchsph.pairs.vectors import per_particle

from ..state.particles import Particles
from .protocols import Stepped, Surroundings
from .weakly_compressible import WeaklyCompressibleSums


class TimeScheme(Protocol):
    """A function that advances every member by its own step; arguments as in ``Stepper.step``."""

    def __call__(
        self, sums: WeaklyCompressibleSums, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
    ) -> Stepped: ...


def symplectic_step(
    sums: WeaklyCompressibleSums, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
) -> Stepped:
    """Symplectic Euler: both passes at the same position; velocity first, then position."""
    dt = per_particle(step, particles.member)
    wall, seen = around.sample(particles), particles
    pairs = sums.pair_search.at(particles)
    filtering = sums.filter_due(number, step)
    rates = sums.rates(particles, pairs, wall, filtering)
    particles = sums.thinned(particles, dt * rates.density)
    particles = sums.filter_density(particles, rates.sums, filtering)
    acceleration = sums.acceleration(particles, pairs, rates.divergence, wall, around)
    velocity = sums.kick(particles, particles.velocity, dt, acceleration)
    particles = sums.damp_at_walls(particles.changed(velocity=velocity), wall, dt)
    drift = dt[:, None] * particles.velocity + sums.position_correction(particles, rates, seen, step)
    return Stepped(particles.changed(position=particles.position + drift), acceleration, wall)


def thesis_step(
    sums: WeaklyCompressibleSums, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
) -> Stepped:
    """Grønli 2017, algorithm 1: density and position with p^n, then forces at the new position, then XSPH.

    First order where forces depend on velocity or density (errata to algorithm 1); kept as the thesis's scheme.
    """
    dt = per_particle(step, particles.member)
    pairs = sums.pair_search.at(particles)
    wall = around.sample(particles) if sums.scheme.wall.complete else None
    rates = sums.rates(particles, pairs, wall)
    particles = sums.thinned(particles, dt * rates.density)
    particles = particles.changed(position=particles.position + dt[:, None] * particles.velocity)
    pairs, wall = sums.pair_search.at(particles), around.sample(particles)
    acceleration = sums.acceleration(particles, pairs, rates.divergence, wall, around)
    particles = particles.changed(velocity=particles.velocity + dt[:, None] * acceleration)
    particles = sums.damp_at_walls(particles, wall, dt)
    return Stepped(sums.smooth_velocity(particles, pairs, sums.filter_due(number, step)), acceleration, wall)


def verlet_step(
    sums: WeaklyCompressibleSums, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
) -> Stepped:
    """Position Verlet (Zhang, Hu & Adams 2017, eqs. 20-23): half drift, kick, half drift; all sums at one position.

    The density takes the midpoint rule at that position. Second order where forces depend on position and density
    (pressure, walls, gravity); viscous forces are taken with the old velocity and are of first order.
    """
    dt = per_particle(step, particles.member)
    start, wall_at_start = particles, around.sample(particles)
    middle = particles.changed(position=particles.position + 0.5 * dt[:, None] * particles.velocity)
    pairs, wall = sums.pair_search.at(middle), around.sample(middle)
    early = sums.rates(middle, pairs, wall)
    middle = sums.thinned(middle, 0.5 * dt * early.density)
    acceleration = sums.acceleration(middle, pairs, early.divergence, wall, around)
    velocity = sums.kick(start, start.velocity, dt, acceleration)
    mean = middle.changed(velocity=0.5 * (start.velocity + velocity))
    late = sums.rates(mean, pairs, wall)
    drift = 0.5 * dt[:, None] * velocity + sums.position_correction(mean, late, mean, step)
    after = sums.thinned(start, dt * late.density).changed(position=middle.position + drift, velocity=velocity)
    return Stepped(sums.damp_at_walls(after, wall, dt), acceleration, wall_at_start)


def predictor_corrector_step(
    sums: WeaklyCompressibleSums, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
) -> Stepped:
    """Symplectic predictor-corrector (Monaghan 2005, sec. 5.3): everything to the half step, then the full step.

    Second order for viscous forces as well, at two full evaluations.
    """
    dt = per_particle(step, particles.member)
    start, half = particles, 0.5 * dt
    pairs, wall_at_start = sums.pair_search.at(start), around.sample(start)
    first = sums.rates(start, pairs, wall_at_start)
    predicted = sums.acceleration(start, pairs, first.divergence, wall_at_start, around)
    middle = sums.thinned(start, half * first.density).changed(
        position=start.position + half[:, None] * start.velocity,
        velocity=sums.kick(start, start.velocity, half, predicted),
    )
    pairs, wall = sums.pair_search.at(middle), around.sample(middle)
    second = sums.rates(middle, pairs, wall)
    acceleration = sums.acceleration(middle, pairs, second.divergence, wall, around)
    velocity = sums.kick(start, start.velocity, dt, acceleration)
    drift = half[:, None] * (start.velocity + velocity)
    drift = drift + sums.position_correction(middle, second, middle, step)
    after = sums.thinned(start, dt * second.density).changed(position=start.position + drift, velocity=velocity)
    return Stepped(sums.damp_at_walls(after, wall, dt), acceleration, wall_at_start)


# by their names in ``WeaklyCompressible.order``
TIME_SCHEMES: dict[str, TimeScheme] = {
    "symplectic": symplectic_step,
    "thesis": thesis_step,
    "verlet": verlet_step,
    "predictor_corrector": predictor_corrector_step,
}
