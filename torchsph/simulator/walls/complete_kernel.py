"""Walls by the kernel's integrals behind them (Ferrand et al. 2013)."""

from __future__ import annotations

from torch import Tensor

from torchsph.pairs.vectors import inner, per_particle, square_length

from ..schemes.wall_models import CompleteKernelWall
from ..state.required import required
from .compiled import complete_forces, complete_rates
from .formulas import friction_rate
from .interface import FluidAtWalls, WallSample, complete_sample


class CompleteKernelForces:
    """``WallForces`` of a complete-kernel wall: sums, pressure and friction over the whole kernel."""

    def __init__(self, model: CompleteKernelWall) -> None:
        self.model = model

    def complete_rates(
        self, divergence: Tensor, gradient: Tensor | None, velocity: Tensor, wall: WallSample
    ) -> tuple[Tensor, Tensor | None]:
        """Divergence (N,) and gradient (N, D) of the concentration with the part of the kernel behind the wall."""
        return complete_rates(divergence, gradient, velocity, complete_sample(wall))

    def accelerate(self, acceleration: Tensor, fluid: FluidAtWalls, wall: WallSample) -> Tensor:
        """With the walls' pressure and laminar friction, over the part of the kernel in the fluid, (N, D)."""
        return complete_forces(
            acceleration,
            fluid.velocity,
            complete_sample(wall),
            member=fluid.member,
            form=fluid.form,
            viscosity=fluid.viscosity if self.model.no_slip else None,
            pressure=fluid.pressure,
            deviation=fluid.deviation,
        )

    def damp(self, fluid: FluidAtWalls, wall: WallSample, dt: Tensor) -> Tensor:
        """The velocities as they are: friction acts through the acceleration."""
        return fluid.velocity

    def power(self, before: Tensor, fluid: FluidAtWalls, wall: WallSample, dt: Tensor) -> Tensor:
        """Power per mass (N,) of the pressure and of the friction.

        Pressure does the work  int p v_wall . n dA; the kernel's integral over the wall is the gradient of its
        completeness, and half of a kernel centred on a plane wall lies inside.
        """
        wall = complete_sample(wall)
        swept = inner(wall.velocity, wall.completeness_gradient) if wall.swept is None else wall.swept
        power = 2.0 * required(fluid.pressure, "the pressure") / (1.0 + fluid.deviation) * swept
        if self.model.no_slip and fluid.viscosity is not None:
            rate = friction_rate(per_particle(fluid.viscosity, fluid.member), wall)
            power = power + rate * (square_length(wall.velocity) - inner(before, wall.velocity))
        return power
