"""Open valves at a given pressure: their buffers carry it, and move as the fluid before them does.

After Tafuni et al. 2018 ("A versatile algorithm for the treatment of open boundary conditions in SPH"), with the
velocity along the normal alone taken from the fluid, by first-order moving least squares just inside the opening.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchsph.pairs.interface import Backend
from torchsph.pairs.moving_least_squares import fetch_at

from ..scene import Valve
from ..state.particles import RESERVOIR, Particles
from .openings import Frame

if TYPE_CHECKING:
    from ..domain import Domain
    from ..stepping.protocols import Stepper

# depth (spacings) inside an opening at which the pressure is read, and the velocity of fluid that enters (new particles
# are noisy); that of fluid that leaves is read in the opening itself, where it may still gather speed. Support of the
# weight that reads them, and how deep particles matter for it.
_DEPTH, _ENTRY, _RADIUS = 1.0, 0.5, 2.0
_REACH = _DEPTH + 1.5**2 * _RADIUS


class PressureValves:
    """What drives the buffers of valves with a given pressure; internal units, all members at once.

    Attributes:
        kinds: (n,) int64, ``Particles.kind`` of these buffers, whose density is not the stepper's to change.
    """

    def __init__(self, domain: Domain, backend: Backend) -> None:
        self.domain, self._reservoirs, self._backend = domain, domain.reservoirs, backend
        # rho0 (v_ref)^2: Pa per internal p / rho0
        self._unit = domain.scene.fluid.density * domain.units.speed**2
        self.kinds = torch.tensor([RESERVOIR + n for n in domain.reservoirs.given], device=domain.device)

    @classmethod
    def of(cls, domain: Domain, backend: Backend) -> PressureValves | None:
        """None where no valve has a given pressure, so that it costs nothing."""
        if domain.reservoirs is None or not domain.reservoirs.given:
            return None
        return cls(domain, backend)

    def driven(self, particles: Particles, stepper: Stepper) -> Particles:
        """Give the buffers the pressure of the present time, and the velocity of the fluid before them."""
        active = [(n, frame) for n, frame in self._reservoirs.active() if n in self._reservoirs.given]
        given = self._given([n for n, _ in active], particles.members)
        for (number, frame), level in zip(active, given, strict=True):
            row = torch.nonzero(particles.kind == RESERVOIR + number).squeeze(1)
            member, height = particles.member[row], frame.height(particles.position[row])
            velocity, inside = self._followed(particles, row, frame, stepper)
            static = level.to(velocity.dtype).index_select(0, member)
            if self._valve(number).stagnation:
                static = static - 0.5 * ((frame.velocity - velocity) @ frame.normal).clamp_min(0.0) ** 2
            # the pressure goes on falling, or rising, as it does from inside to the opening: a step there would put
            # the opening a kernel's radius too far out
            slope = _mean(static - inside, member, particles.members)
            reach = height.clamp_max(self.domain.support_radius) / _DEPTH
            pressure = static + slope.index_select(0, member) * reach
            particles = particles.changed(velocity=particles.velocity.index_copy(0, row, velocity))
            particles = stepper.at_pressure(particles, row, pressure)
        return particles

    def _valve(self, number: int) -> Valve:
        return self._reservoirs.valves[self._reservoirs.valve_of[number]]

    def _given(self, numbers: list[int], members: int) -> list[Tensor]:
        """Pressure p / rho0 (members,) of openings, from their mean: a constant that all share moves nothing.

        Times each member's valve strength.
        """
        times = self.domain.member_times(members).tolist()
        rows = [[self._valve(n).pressure_at(t) for t in times] for n in numbers]
        if not rows:
            return []
        table = torch.tensor(rows, dtype=torch.float64, device=self.domain.device) / self._unit
        return list((table - table.mean(0)) * self.domain.valve_strength)

    def _followed(self, particles: Particles, row: Tensor, frame: Frame, stepper: Stepper) -> tuple[Tensor, Tensor]:
        """What a buffer's particles in ``row`` find inside the opening: velocity (n, D) and p / rho0 (n,).

        The velocity is the opening's own, and the fluid's along the normal.
        """
        mine, height = particles.select(row), frame.height(particles.position[row])
        near = particles.select(particles.inside & (frame.height(particles.position).abs() < _REACH))

        def read(values: Tensor, old: Tensor, depth: Tensor) -> Tensor:
            place = mine.position - (height + depth)[:, None] * frame.normal
            found = fetch_at(
                self._backend,
                place,
                mine.member,
                near.position,
                near.member,
                values[:, None],
                _RADIUS,
                period=self.domain.period,
            )
            return torch.where(found.covered, found.value[:, 0], old)

        deep = torch.full_like(height, _DEPTH)
        old = (mine.velocity - frame.velocity) @ frame.normal
        leaves = _mean(old, mine.member, mine.members).index_select(0, mine.member) > 0
        along = read((near.velocity - frame.velocity) @ frame.normal, old, _ENTRY * (~leaves).to(deep.dtype))
        pressure = read(stepper.pressure(near), stepper.pressure(mine), deep)
        return frame.velocity + along[:, None] * frame.normal, pressure


def _mean(values: Tensor, member: Tensor, members: int) -> Tensor:
    """Mean (members,) of values (n,) over each member."""
    total = values.new_zeros((2, members))
    total = total.index_add(1, member, torch.stack([values, torch.ones_like(values)]))
    return total[0] / total[1].clamp_min(1.0)
