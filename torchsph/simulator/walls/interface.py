"""What particles see of walls, and what a wall model does to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True)
class WallSample:
    """The walls as particles see them, internal units.

    Attributes:
        distance: (N,), positive in the fluid.
        normal: (N, D), unit, into the fluid.
        velocity: (N, D) of the nearest wall point.
    """

    distance: Tensor
    normal: Tensor
    velocity: Tensor


@dataclass(frozen=True)
class CompleteWallSample(WallSample):
    """Walls with the part of the particles' kernels that they cut off (Ferrand et al. 2013, sec. 3).

    Attributes:
        completeness: (N,), integral of the kernel over the fluid domain (gamma there).
        completeness_gradient: (N, D), its gradient, which points into the fluid.
        swept: (N,), integral of the kernel times the wall's normal velocity (inwards) over its surface, or None: the
            nearest point's velocity stands for all of the wall.
        rows: (N, C), all of it side by side for compiled code, or None.
    """

    completeness: Tensor
    completeness_gradient: Tensor
    swept: Tensor | None = None
    rows: Tensor | None = None


def complete_sample(wall: WallSample) -> CompleteWallSample:
    """The same walls, where they come with the kernel's completeness.

    Raises:
        ValueError: they do not.
    """
    if not isinstance(wall, CompleteWallSample):
        raise ValueError("these walls come without the kernel's completeness; use a wall model that is complete")
    return wall


@dataclass(frozen=True)
class FluidAtWalls:
    """What a wall model needs to know of the particles, internal units.

    Attributes:
        velocity: (N, D).
        deviation: (N,), of the density.
        member: (N,) int64.
        form: of the pressure force (``MomentumTerms.pressure``).
        pressure: (N,), p / rho0, or None: pressure is not the walls' to transmit.
        sound_speed: a number or (members,), or None in an incompressible fluid.
        viscosity: kinematic, a number or (members,), or None without.
    """

    velocity: Tensor
    deviation: Tensor
    member: Tensor
    form: str = "symmetric"
    pressure: Tensor | None = None
    sound_speed: float | Tensor | None = None
    viscosity: float | Tensor | None = None


class WallForces(Protocol):
    """What walls of one model do to particles; made from the model's options by ``registry.wall_forces``."""

    def complete_rates(
        self, divergence: Tensor, gradient: Tensor | None, velocity: Tensor, wall: WallSample
    ) -> tuple[Tensor, Tensor | None]:
        """First-pass sums with what walls add to them.

        Args:
            divergence: (N,), of the velocity, summed over pairs.
            gradient: (N, D), of the concentration, summed over pairs, or None.
            velocity: (N, D).
            wall: walls at the particles.
        """

    def accelerate(self, acceleration: Tensor, fluid: FluidAtWalls, wall: WallSample) -> Tensor:
        """Accelerations (N, D) by pairs and walls, from those by pairs (N, D)."""

    def damp(self, fluid: FluidAtWalls, wall: WallSample, dt: Tensor) -> Tensor:
        """Velocities (N, D) after ``dt`` (N,) of a friction that is no acceleration; ``fluid.velocity`` without one."""

    def power(self, before: Tensor, fluid: FluidAtWalls, wall: WallSample, dt: Tensor) -> Tensor:
        """Power per mass of moving walls on the particles in a step; few passes, because every step pays for them.

        Args:
            before: (N, D), velocities at the start of the step.
            fluid: at its end, with its pressure.
            wall: walls that the step saw.
            dt: (N,), length of the step.

        Returns:
            (N,).
        """
