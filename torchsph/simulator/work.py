"""The work that moving walls and pressure sources do on the fluid, step by step, for the record.

With the energy that valves carry (``Reservoirs.exchange``) it balances the fluid's energy: what is missing was
dissipated, or is stored in the compression of a weakly compressible fluid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchsph.pairs.vectors import per_particle

from .domain import Domain
from .state.particles import Particles
from .state.record import Record
from .walls.interface import FluidAtWalls, WallSample
from .walls.registry import wall_forces

if TYPE_CHECKING:
    from .stepping.protocols import Stepper


class WorkAccount:
    """Adds the work of each step to a record.

    Pressure does the work  int p v_wall . n dA,  as a sum over the particles whose kernels the wall cuts: the kernel's
    integral over the wall is the gradient of its completeness (Ferrand et al. 2013), and half of a kernel centred on a
    plane wall lies inside. Where the wall is curved or folded that half is off by the curvature over a kernel's radius.
    A potential wall does the work of the force and the retardation that particles feel. What walls do to particles that
    they stop outright is added where that happens (``Domain.constrain``).
    """

    def __init__(self, domain: Domain, record: Record) -> None:
        self._record, self._walls = record, wall_forces(domain.scheme.wall)
        self._moving = domain.walls is not None and bool(domain.walls.motion.rates_at_keys.any())
        self._unit = domain.energy_unit

    @classmethod
    def of(cls, domain: Domain, record: Record) -> WorkAccount | None:
        """The account of a scene; None where nothing can do work, so that it costs nothing."""
        account = cls(domain, record)
        return account if account._moving or domain.valves.does_work else None

    @torch.no_grad()  # an account, not a part of the flow
    def note(
        self,
        before: Particles,
        stepped: Particles,
        wall: WallSample | None,
        step: Tensor,
        stepper: Stepper,
        counts: Tensor,
        by_valves: Tensor | None,
    ) -> None:
        """Account for one step.

        Args:
            before: the particles before the step.
            stepped: the particles after it, not yet stopped by walls.
            wall: what they saw.
            step: (members,), internal.
            stepper: what knows pressure and coefficients.
            counts: (members,) bool, whose steps were taken.
            by_valves: (N, D), acceleration by pressure sources, or None.
        """
        if self._moving and wall is not None:
            power = self._power_of_walls(before, stepped, wall, step, stepper) * stepped.mass * stepped.inside
            self._add("wall_work", stepped.per_member(power, "sum"), step, counts)
        if by_valves is not None:
            power = 0.5 * before.mass * (by_valves * (before.velocity + stepped.velocity)).sum(1)
            self._add("source_work", before.per_member(power.double(), "sum"), step, counts)

    def _add(self, name: str, power: Tensor, step: Tensor, counts: Tensor) -> None:
        """Add what a power (members,), internal, does in a step to an account."""
        work = power.double() * step.double() * self._unit
        getattr(self._record, name).add_(torch.where(counts, work, torch.zeros_like(work)))

    def _power_of_walls(
        self,
        before: Particles,
        stepped: Particles,
        wall: WallSample,
        step: Tensor,
        stepper: Stepper,
    ) -> Tensor:
        """Power per mass (N,) of the walls on the particles, internal; few passes, because every step pays for them."""
        c = stepper.coefficients
        fluid = FluidAtWalls(
            stepped.velocity,
            stepped.deviation,
            stepped.member,
            pressure=stepper.pressure(stepped),
            sound_speed=c.sound_speed,
            viscosity=c.viscosity,
        )
        return self._walls.power(before.velocity, fluid, wall, per_particle(step, stepped.member))
