"""Time steps of second order: position Verlet and the symplectic predictor-corrector.

Shifting and position XSPH are displacements per step in both: they even the particles out and have no order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from torchsph.pairs.vectors import per_particle

from ..state.particles import Particles
from ..walls.forces import WallSample

if TYPE_CHECKING:
    from .weakly_compressible import Stepper, Surroundings


def verlet_step(
    stepper: Stepper, particles: Particles, step: Tensor, around: Surroundings
) -> tuple[Particles, Tensor, WallSample | None]:
    """Position Verlet (Zhang, Hu & Adams 2017 eqs. 20-23): half drift, kick, half drift; all sums at one position.

    The density takes the midpoint rule at that position. Second order where forces depend on position and density
    (pressure, walls, gravity); viscous forces are taken with the old velocity and are of first order.
    """
    dt = per_particle(step, particles.member)
    start, begin = particles, around.sample(particles)
    middle = particles.changed(position=particles.position + 0.5 * dt[:, None] * particles.velocity)
    pairs, wall = stepper.pair_search.at(middle), around.sample(middle)
    early = stepper.evaluate_rates(middle, pairs, wall)
    middle = middle.changed(deviation=start.deviation + 0.5 * dt * early.rate)
    acceleration = stepper.acceleration(middle, pairs, early.divergence, wall, around)
    velocity = stepper.kicked(start, start.velocity, dt, acceleration)
    mean = middle.changed(velocity=0.5 * (start.velocity + velocity))
    late = stepper.evaluate_rates(mean, pairs, wall)
    drift = 0.5 * dt[:, None] * velocity + stepper.wandering(mean, late.sums, late.crowding, step, mean)
    moved = middle.position + drift
    after = start.changed(position=moved, velocity=velocity, deviation=start.deviation + dt * late.rate)
    return stepper.retarded(after, wall, dt), acceleration, begin


def predictor_corrector_step(
    stepper: Stepper, particles: Particles, step: Tensor, around: Surroundings
) -> tuple[Particles, Tensor, WallSample | None]:
    """Symplectic predictor-corrector (Monaghan 2005 section 5.3): everything to the half step, then the full step.

    Second order for viscous forces as well, at two full evaluations.
    """
    dt = per_particle(step, particles.member)
    start, half = particles, 0.5 * dt
    pairs, begin = stepper.pair_search.at(start), around.sample(start)
    first = stepper.evaluate_rates(start, pairs, begin)
    push = stepper.acceleration(start, pairs, first.divergence, begin, around)
    middle = start.changed(
        position=start.position + half[:, None] * start.velocity,
        velocity=stepper.kicked(start, start.velocity, half, push),
        deviation=start.deviation + half * first.rate,
    )
    pairs, wall = stepper.pair_search.at(middle), around.sample(middle)
    second = stepper.evaluate_rates(middle, pairs, wall)
    acceleration = stepper.acceleration(middle, pairs, second.divergence, wall, around)
    velocity = stepper.kicked(start, start.velocity, dt, acceleration)
    drift = half[:, None] * (start.velocity + velocity)
    drift = drift + stepper.wandering(middle, second.sums, second.crowding, step, middle)
    after = start.changed(
        position=start.position + drift, velocity=velocity, deviation=start.deviation + dt * second.rate
    )
    return stepper.retarded(after, wall, dt), acceleration, begin
