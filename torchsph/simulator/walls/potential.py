"""Walls by a soft potential (Grønli 2017, sec. 3.1 and 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsph.pairs.vectors import column, inner, per_particle

from ..schemes.wall_models import PotentialWall
from .interface import FluidAtWalls, WallSample


def _depth(model: PotentialWall, wall: WallSample) -> Tensor:
    """s = 1 - d / reach, clipped to [0, 2]: how deep in the potential; the clip bounds the force beyond the wall."""
    return (1.0 - wall.distance / model.reach).clamp(0.0, 2.0)


def potential(model: PotentialWall, sound_speed: float | Tensor, wall: WallSample) -> Tensor:
    """U = stiffness c^2 s^2 / 2, (N,)."""
    return 0.5 * model.stiffness * sound_speed**2 * _depth(model, wall) ** 2


def potential_force(model: PotentialWall, sound_speed: float | Tensor, wall: WallSample) -> Tensor:
    """-grad U (Grønli 2017, eq. 3.1) as acceleration (N, D)."""
    strength = model.stiffness * sound_speed**2 / model.reach * _depth(model, wall)
    return strength[:, None] * wall.normal


def damped_velocity(
    model: PotentialWall, sound_speed: float | Tensor, dt: Tensor, velocity: Tensor, wall: WallSample
) -> Tensor:
    """Velocity after the no-slip retardation (Grønli 2017, eq. 3.2).

    With the errata: relative to the wall, and per time, not per step.

    Args:
        model: options.
        sound_speed: internal, a number or (N,).
        dt: (N,), internal time; negative: what the velocity was before.
        velocity: (N, D), internal.
        wall: walls at the particles.

    Returns:
        (N, D), internal; ``velocity`` itself where the walls slip.
    """
    if model.relaxation is None:
        return velocity
    relative = velocity - wall.velocity
    tangential = relative - (relative * wall.normal).sum(1, keepdim=True) * wall.normal
    rate = _depth(model, wall) * sound_speed / (model.relaxation * model.reach)
    return velocity + torch.expm1(-dt * rate)[:, None] * tangential


class PotentialForces:
    """``WallForces`` of a potential wall: a force along the normal, a damping of what slides along the wall."""

    def __init__(self, model: PotentialWall) -> None:
        self.model = model

    def complete_rates(
        self, divergence: Tensor, gradient: Tensor | None, velocity: Tensor, wall: WallSample
    ) -> tuple[Tensor, Tensor | None]:
        """The sums as they are: nothing stands for the kernel behind the wall."""
        return divergence, gradient

    def accelerate(self, acceleration: Tensor, fluid: FluidAtWalls, wall: WallSample) -> Tensor:
        """With the potential's force (N, D)."""
        return acceleration + potential_force(self.model, _sound(fluid), wall)

    def damp(self, fluid: FluidAtWalls, wall: WallSample, dt: Tensor) -> Tensor:
        """Velocities (N, D) after the retardation."""
        return damped_velocity(self.model, _sound(fluid), dt, fluid.velocity, wall)

    def power(self, before: Tensor, fluid: FluidAtWalls, wall: WallSample, dt: Tensor) -> Tensor:
        """Power per mass (N,) of the force and the retardation that particles feel."""
        sound = _sound(fluid)
        force = potential_force(self.model, sound, wall)
        if self.model.relaxation is not None:
            # a step backwards from where it has led gives what it has changed
            change = fluid.velocity - damped_velocity(self.model, sound, -dt, fluid.velocity, wall)
            force = force + change / column(dt.clamp_min(torch.finfo(dt.dtype).tiny))
        return inner(force, wall.velocity)


def _sound(fluid: FluidAtWalls) -> float | Tensor:
    """Speed of sound, a number or (N,).

    Raises:
        ValueError: the fluid has none.
    """
    if fluid.sound_speed is None:
        raise ValueError("a potential wall is as stiff as the fluid's sound is fast: it needs a compressible scheme")
    return per_particle(fluid.sound_speed, fluid.member)
