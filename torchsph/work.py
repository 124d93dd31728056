"""The work that moving walls and pressure sources do on the fluid, step by step, for the record.

With the energy that valves carry (``Reservoirs.exchange``) it balances the fluid's energy: what is missing was
dissipated, or is stored in the compression of a weakly compressible fluid.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .pairs.interface import per_particle, square_length
from .particles import Particles
from .record import Record
from .schemes import CompleteKernelWall, PotentialWall
from .units import Units
from .walls import WallSample, friction, potential_force, retardation

if TYPE_CHECKING:
    from .domain import Domain
    from .integrate import Stepper
    from .projection import ProjectionStepper


def energy_unit(units: Units, density: float, dimension: int) -> float:
    """J (in a plane J/m) of a particle of one internal mass with twice the reference speed squared / 2."""
    return density * units.length**dimension * units.speed**2


def carried_energy(particles: Particles, pressure: Tensor) -> Tensor:
    """What particles carry through an opening: kinetic energy and the work p V of the pressure (N,), internal."""
    per_mass = 0.5 * square_length(particles.velocity) + pressure / (1.0 + particles.deviation)
    return (particles.mass * per_mass).double()


class WorkAccount:
    """Adds the work of each step to a record.

    Pressure does the work  int p v_wall . n dA,  as a sum over the particles whose kernels the wall cuts: the kernel's
    integral over the wall is the gradient of its share inside (Ferrand et al. 2013), and half of a kernel centred on a
    plane wall lies inside. Where the wall is curved or folded that half is off by the curvature over a kernel's radius.
    A potential wall does the work of its force and of its retardation, which is exact.
    """

    def __init__(self, domain: Domain, record: Record) -> None:
        self._record, self._wall, self._reach = record, domain.scheme.wall, domain.support_radius
        self._friction = isinstance(self._wall, CompleteKernelWall) and self._wall.no_slip
        if isinstance(self._wall, PotentialWall):
            self._reach = self._wall.reach
        self._sources = domain.sources
        self._moving = domain.walls is not None and bool(domain.scene.walls.rates_at_keys.any())
        self._unit = energy_unit(domain.units, domain.scene.fluid.density, domain.scene.dimension)

    @classmethod
    def of(cls, domain: Domain, record: Record) -> WorkAccount | None:
        """The account of a scene; None where nothing can do work, so that it costs nothing."""
        account = cls(domain, record)
        return account if account._moving or account._sources is not None else None

    def note(
        self, before: Particles, stepped: Particles, after: Particles, wall: WallSample | None, step: Tensor,
        stepper: Stepper | ProjectionStepper, counts: Tensor,
    ) -> None:
        """Account for one step.

        Args:
            before, stepped, after: the particles before the step, after it, and after walls have stopped them.
            wall: what they saw. step: (members,), internal. counts: (members,) bool, whose steps were taken.
        """
        if self._moving and wall is not None:
            self._add("wall_work", self._by_walls(before, stepped, after, wall, step, stepper), counts)
        if self._sources is not None and self._sources.push is not None:
            mean = 0.5 * (before.velocity + stepped.velocity)
            gained = per_particle(step, before.member) * (self._sources.push * mean).sum(1) * before.mass
            self._add("source_work", before.per_member(gained.double(), "sum"), counts)

    def _add(self, name: str, work: Tensor, counts: Tensor) -> None:
        """Add (members,) of internal work to an account."""
        getattr(self._record, name).add_(torch.where(counts, work * self._unit, torch.zeros_like(work)))

    def _by_walls(
        self, before: Particles, stepped: Particles, after: Particles, wall: WallSample, step: Tensor,
        stepper: Stepper | ProjectionStepper,
    ) -> Tensor:
        """Work (members,) float64 of the walls on the particles inside, internal."""
        row = torch.nonzero((wall.distance < self._reach) & before.inside).squeeze(1)
        near = WallSample(*(None if part is None else part[row] for part in vars(wall).values()))
        mine, c = stepped.select(row), stepper.coefficients
        dt = per_particle(step, mine.member)
        impulse = after.velocity[row] - mine.velocity
        if isinstance(self._wall, PotentialWall):
            sound = per_particle(c.sound_speed, mine.member)
            impulse = impulse + dt[:, None] * potential_force(self._wall, sound, near)
            if self._wall.relaxation is not None:
                # a step backwards from where it has led gives what it has changed
                impulse = impulse + mine.velocity - retardation(self._wall, sound, -dt, mine.velocity, near)
        elif self._friction and c.viscosity is not None:
            drag = friction(per_particle(c.viscosity, mine.member), before.velocity[row], near)
            impulse = impulse + dt[:, None] * drag
        work = mine.mass * (impulse * near.velocity).sum(1)
        if near.share_gradient is not None:
            swept = (near.velocity * near.share_gradient).sum(1) if near.swept is None else near.swept
            work = work + 2.0 * dt * mine.mass * stepper.pressure(mine) / (1.0 + mine.deviation) * swept
        return mine.per_member(work.double(), "sum")
