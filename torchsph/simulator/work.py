"""The work that moving walls and pressure sources do on the fluid, step by step, for the record.

With the energy that valves carry (``Reservoirs.exchange``) it balances the fluid's energy: what is missing was
dissipated, or is stored in the compression of a weakly compressible fluid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchsph.pairs.vectors import inner, per_particle, square_length

from .domain import Domain
from .schemes.wall_models import PotentialWall
from .state.particles import Particles
from .state.record import Record
from .walls.forces import WallSample, friction_rate, potential_force, retardation

if TYPE_CHECKING:
    from .stepping.protocols import Stepper


class WorkAccount:
    """Adds the work of each step to a record.

    Pressure does the work  int p v_wall . n dA,  as a sum over the particles whose kernels the wall cuts: the kernel's
    integral over the wall is the gradient of its share inside (Ferrand et al. 2013), and half of a kernel centred on a
    plane wall lies inside. Where the wall is curved or folded that half is off by the curvature over a kernel's radius.
    A potential wall does the work of the force and the retardation that particles feel. What walls do to particles that
    they stop outright is added where that happens (``Domain.constrain``).
    """

    def __init__(self, domain: Domain, record: Record) -> None:
        self._record, self._wall = record, domain.scheme.wall
        self._moving = domain.walls is not None and bool(domain.walls.motion.rates_at_keys.any())
        self._unit = domain.energy_unit

    @classmethod
    def of(cls, domain: Domain, record: Record) -> WorkAccount | None:
        """The account of a scene; None where nothing can do work, so that it costs nothing."""
        account = cls(domain, record)
        return account if account._moving or domain.valves.does_work else None

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
            before, stepped: the particles before the step and after it, not yet stopped by walls.
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
        if isinstance(self._wall, PotentialWall):
            sound = per_particle(c.sound_speed, stepped.member)
            force = potential_force(self._wall, sound, wall)
            if self._wall.relaxation is not None:
                # a step backwards from where it has led gives what it has changed
                dt = per_particle(step, stepped.member)
                change = stepped.velocity - retardation(self._wall, sound, -dt, stepped.velocity, wall)
                force = force + change / dt.clamp_min(torch.finfo(dt.dtype).tiny)[:, None]
            return inner(force, wall.velocity)
        swept = inner(wall.velocity, wall.share_gradient) if wall.swept is None else wall.swept
        power = 2.0 * stepper.pressure(stepped) / (1.0 + stepped.deviation) * swept
        if self._wall.no_slip and c.viscosity is not None:
            rate = friction_rate(per_particle(c.viscosity, stepped.member), wall)
            power = power + rate * (square_length(wall.velocity) - inner(before.velocity, wall.velocity))
        return power
