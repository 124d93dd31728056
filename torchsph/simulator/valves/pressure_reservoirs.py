"""Open valves at a given pressure: their buffers carry it, and move as the fluid before them does.

After Tafuni et al. 2018 ("A versatile algorithm for the treatment of open boundary conditions in SPH"), with the
velocity along the normal alone taken from the fluid, by first-order moving least squares just inside the opening.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from torchsph.pairs.interface import Backend
from torchsph.pairs.moving_least_squares import fetch_at

from ..state.clock import Clock
from ..state.particles import RESERVOIR, Particles
from .openings import OpeningPlane, Openings
from .plane_groups import apart

# depth (spacings) inside an opening at which the pressure is read, and the velocity of fluid that enters (new particles
# are noisy); that of fluid that leaves is read in the opening itself, where it may still gather speed. Support of the
# weight that reads them, and how deep particles matter for it.
_DEPTH, _ENTRY, _RADIUS = 1.0, 0.5, 2.0
_REACH = _DEPTH + 1.5**2 * _RADIUS


class PressureScheme(Protocol):
    """How a scheme knows the pressure of particles."""

    def pressure(self, particles: Particles) -> Tensor:
        """p / rho0 (N,)."""

    def at_pressure(self, particles: Particles, row: Tensor, pressure: Tensor) -> Particles:
        """Particles whose ``row`` (n,) carry ``pressure`` (n,), p / rho0."""


class PressureReservoirs:
    """What drives the buffers of valves with a given pressure; internal units, all members at once.

    Args:
        openings: of the scene's valves.
        backend: for what is read inside the openings.
        support_radius: of the smoothing kernel.
        pressure_unit: rho0 (v_ref)^2, Pa per internal p / rho0.
        period: (D,) of the periodic box, or None.

    Attributes:
        kinds: (n,) int64, ``Particles.kind`` of these buffers, whose density is not the stepper's to change.
    """

    def __init__(
        self,
        openings: Openings,
        backend: Backend,
        support_radius: float,
        pressure_unit: float,
        period: Tensor | None,
        device: str,
    ) -> None:
        self._openings, self._backend, self._device = openings, backend, device
        self._support_radius, self._unit, self._period = support_radius, pressure_unit, period
        self.kinds = torch.tensor([RESERVOIR + n for n in openings.given], device=device)

    def driven(self, particles: Particles, clock: Clock, scheme: PressureScheme, stepping: Tensor) -> Particles:
        """Give the buffers of the members ``stepping`` (members,) bool the pressure of the present time.

        And the velocity of the fluid before them.
        """
        return apart(
            self._openings, particles, clock, lambda some, at: (self._driven(some, at, scheme), False), stepping
        )[0]

    def _driven(self, particles: Particles, clock: Clock, scheme: PressureScheme) -> Particles:
        """The same for members that see the same planes."""
        active = [(n, plane) for n, plane in self._openings.active(clock) if n in self._openings.given]
        given = self._given([n for n, _ in active], particles.members, clock)
        for (number, plane), level in zip(active, given, strict=True):
            row = torch.nonzero(particles.kind == RESERVOIR + number).squeeze(1)
            member, height = particles.member[row], plane.height(particles.position[row])
            velocity, inside = self._followed(particles, row, plane, scheme)
            static = level.to(velocity.dtype).index_select(0, member)
            if self._openings.valve(number).stagnation:
                static = static - 0.5 * ((plane.velocity - velocity) @ plane.normal).clamp_min(0.0) ** 2
            # the pressure goes on falling, or rising, as it does from inside to the opening: a step there would put
            # the opening a kernel's radius too far out
            slope = _mean(static - inside, member, particles.members)
            reach = height.clamp_max(self._support_radius) / _DEPTH
            pressure = static + slope.index_select(0, member) * reach
            particles = particles.changed(velocity=particles.velocity.index_copy(0, row, velocity))
            particles = scheme.at_pressure(particles, row, pressure)
        return particles

    def _given(self, numbers: list[int], members: int, clock: Clock) -> list[Tensor]:
        """Pressure p / rho0 (members,) of openings, from their mean: a constant that all share moves nothing.

        Times each member's valve strength.
        """
        times = clock.of_members(members).tolist()
        rows = [[self._openings.valve(n).pressure_at(t) for t in times] for n in numbers]
        if not rows:
            return []
        table = torch.tensor(rows, dtype=torch.float64, device=self._device) / self._unit
        return list((table - table.mean(0)) * clock.valve_strength)

    def _followed(
        self, particles: Particles, row: Tensor, plane: OpeningPlane, scheme: PressureScheme
    ) -> tuple[Tensor, Tensor]:
        """What a buffer's particles in ``row`` find inside the opening: velocity (n, D) and p / rho0 (n,).

        The velocity is the opening's own, and the fluid's along the normal.
        """
        buffer, height = particles.select(row), plane.height(particles.position[row])
        near = particles.select(particles.inside & (plane.height(particles.position).abs() < _REACH))

        def read(values: Tensor, old: Tensor, depth: Tensor) -> Tensor:
            place = buffer.position - (height + depth)[:, None] * plane.normal
            found = fetch_at(
                self._backend,
                place,
                buffer.member,
                near.position,
                near.member,
                values[:, None],
                _RADIUS,
                period=self._period,
            )
            return torch.where(found.covered, found.value[:, 0], old)

        deep = torch.full_like(height, _DEPTH)
        old = (buffer.velocity - plane.velocity) @ plane.normal
        leaves = _mean(old, buffer.member, buffer.members).index_select(0, buffer.member) > 0
        along = read((near.velocity - plane.velocity) @ plane.normal, old, _ENTRY * (~leaves).to(deep.dtype))
        pressure = read(scheme.pressure(near), scheme.pressure(buffer), deep)
        return plane.velocity + along[:, None] * plane.normal, pressure


def _mean(values: Tensor, member: Tensor, members: int) -> Tensor:
    """Mean (members,) of values (n,) over each member."""
    total = values.new_zeros((2, members))
    total = total.index_add(1, member, torch.stack([values, torch.ones_like(values)]))
    return total[0] / total[1].clamp_min(1.0)
