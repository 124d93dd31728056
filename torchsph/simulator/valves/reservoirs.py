"""Open valves as openings with a buffer of particles behind them, whose flux follows from dV/dt.

The buffer is a straight channel outward of the orifice, a little longer than the kernel's support.  Its particles are
neighbours of the fluid but move with a prescribed velocity: the orifice's own, plus a profile along its normal scaled
so that the flux through the orifice equals the rate at which the cavity grows.  A buffer particle that crosses the
plane inward becomes fluid and is replaced at the far end; a fluid particle that crosses outward becomes buffer, keeps
its share of the profile, and is removed at the far end.  Behind an outlet the first part of the channel may be left
free: there only the flux is prescribed, by the same change of speed for all, and the profile is the flow's own.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchsph.pairs.interface import Backend

from ..schemes.valve_models import Reservoir
from ..state.clock import Clock
from ..state.particles import CHANNEL, FLUID, RESERVOIR, Particles
from ..state.record import Record
from ..transfer.exchange import exchanged
from .accounts import note_passed
from .buffer_flow import AREA_TRUST, mean_near, scaled_profile, volume_of_rows, with_channel_flux
from .cavity_volume import CavityVolume
from .flux_split import fluxes
from .free_channel import free_length
from .model import Pressure, ValveModel, ValveSetting
from .openings import OpeningPlane, Openings
from .plane_groups import apart, measured_apart
from .pressure_reservoirs import PressureReservoirs
from .shared_flux import MOUTH, SharedFlux
from .volume_match import levelled, volume_inside

# how far beyond the plane (spacings) an outgoing particle changes to buffer, and an incoming one to fluid
_HYSTERESIS = 0.25


class Reservoirs(ValveModel):
    """Buffers behind the valves of a scene.

    Attributes:
        openings: of the valves.
        volume: of the cavity.
        relaxation: time, internal, in which what the particles' volume lacks is let in, or None.
    """

    has_buffers = True

    def __init__(self, model: Reservoir, setting: ValveSetting) -> None:
        scene = setting.scene
        self._setting, self.units, self._density = setting, setting.units, scene.fluid.density
        self._flat, self._run_out, self.relaxation = model.profile == "flat", model.run_out, model.relaxation
        self._far = self._run_out + float(np.ceil(setting.support_radius) + 1.0)  # where the buffer ends
        self.openings = Openings(scene, setting.units, setting.device, setting.dtype)
        self.buffers = len(self.openings.all)
        self.volume = CavityVolume(
            self.openings.motion,
            setting.units,
            setting.wrapped_time,
            self.relaxation is not None,
            setting.device,
            setting.dtype,
        )
        self._shared = SharedFlux(self.openings, self.volume)
        given = (self.openings.valve(number).flux is not None for number in range(self.buffers))
        self.takes_strength = bool(self.openings.given) or any(given)

    def pressure_reservoirs(self, backend: Backend) -> PressureReservoirs | None:
        """What drives the buffers of valves with a given pressure, or None."""
        if not self.openings.given:
            return None
        unit, s = self._density * self.units.speed**2, self._setting
        return PressureReservoirs(self.openings, backend, s.support_radius, unit, s.period, s.device)

    def _deficit(self, particles: Particles, clock: Clock) -> Tensor:
        """Volume that the particles inside fall short of the cavity's, (members,), internal; of the same planes."""
        filled = volume_inside(particles, [plane for _, plane in self.openings.active(clock)])
        wanted = self.volume.volume(clock.of_members(particles.members), torch.float64)
        return (wanted - filled).to(self._setting.dtype)

    def volume_deficit_rate(self, particles: Particles, clock: Clock) -> Tensor:
        """Part of the cavity's volume, per time, that should come in for what particles lack, (members,)."""
        times = clock.of_members(particles.members)
        if self.relaxation is None:
            return torch.zeros_like(times, dtype=self._setting.dtype)
        deficit = measured_apart(self.openings, particles, clock, self._deficit)
        return deficit / (self.volume.volume(times) * self.relaxation)

    def _lead(self, number: int, clock: Clock, members: int) -> float | Tensor:
        return free_length(self.openings, self.volume, self._run_out, number, clock, members)

    def split_points(self, clock: Clock) -> Tensor | None:
        """See ``SharedFlux.points``."""
        return self._shared.points(clock)

    def open_points(self, clock: Clock) -> Tensor | None:
        """See ``SharedFlux.open_points``."""
        return self._shared.open_points(clock)

    def through_open(self, velocity: Tensor, clock: Clock) -> Tensor:
        """See ``SharedFlux.through_open``."""
        return self._shared.through_open(velocity, clock)

    def note_split(self, velocity: Tensor, clock: Clock) -> None:
        """See ``SharedFlux.read_field``."""
        self._shared.read_field(velocity, clock)

    def opened(self, particles: Particles, clock: Clock) -> Particles:
        """Make the buffers of valves that are open and have none, drop those of valves that have shut."""
        gone = self.openings.shut(clock)
        if gone:
            kind = torch.tensor([k for n in gone for k in (RESERVOIR + n, CHANNEL - n)], device=particles.kind.device)
            stay = ~torch.isin(particles.kind, kind)
            particles = particles if bool(stay.all()) else particles.select(stay)
        if clock.flux_split is None:
            self._shared.read_buffers(particles, clock)
        for number, plane in self.openings.active(clock):
            has = particles.per_member((particles.kind == RESERVOIR + number).to(torch.int64), "sum") > 0
            empty = torch.nonzero(~has).squeeze(1)
            if empty.numel():
                particles = particles.joined(self._buffer(particles, number, plane, empty, clock))
        return particles

    def _buffer(
        self, particles: Particles, number: int, plane: OpeningPlane, members: Tensor, clock: Clock
    ) -> Particles:
        """A fresh lattice in the channel of one valve for some members, its first part free where fluid leaves."""
        place = plane.lattice(self._far)
        count, copies = place.shape[0], members.numel()
        lead = self._lead(number, clock, particles.members)
        lead = lead[members].repeat_interleave(count) if isinstance(lead, Tensor) else lead
        height = plane.height(place).repeat(copies)
        kind = torch.where(height < lead, CHANNEL - number, RESERVOIR + number)
        # a lattice does not tile an opening: its particles share the channel's volume
        mass = place.new_full((members.numel(),), plane.area * self._far / max(count, 1))
        return Particles(
            position=place.repeat(copies, 1),
            velocity=place.new_zeros((count * copies, place.shape[1])),
            deviation=mean_near(particles, plane, particles.deviation)[members].repeat_interleave(count),
            mass=mass.repeat_interleave(count),
            member=members.repeat_interleave(count),
            kind=kind,
            members=particles.members,
        )

    def driven(self, particles: Particles, clock: Clock, *, channel: bool = False) -> Particles:
        """Give the buffers' particles their velocity for the present time; with ``channel`` also the free channels'."""
        if not clock.open_regions:
            return particles
        work = partial(self._driven, channel=channel)
        return apart(self.openings, particles, clock, lambda some, at: (work(some, at), False))[0]

    def _driven(self, particles: Particles, clock: Clock, *, channel: bool) -> Particles:
        """The same for members that see the same planes."""
        times = clock.of_members(particles.members)
        inflow, active, given = self.volume.rate(times), self.openings.active(clock), self.openings.given
        if particles.exchange is not None:
            inflow = inflow - exchanged(particles)
        if self.relaxation is not None and not channel and not any(number in given for number, _ in active):
            inflow = inflow + self._deficit(particles, clock) / self.relaxation
            if self._setting.compressible:
                particles = levelled(particles, [plane for _, plane in active])
        velocity, through = particles.velocity, fluxes(self.openings, clock, inflow)
        for number, plane in active:
            if number in given:
                continue
            buffer, free = particles.kind == RESERVOIR + number, particles.kind == CHANNEL - number
            row = torch.nonzero(buffer | free if channel else buffer).squeeze(1)
            lead = self._lead(number, clock, particles.members)
            length = self._far if channel else self._far - lead
            owner, old = particles.member[row], velocity[row]
            along = (old * plane.normal).sum(1)
            own = plane.velocity
            speed = -through[number] / plane.area  # outward
            # what enters must be what is wanted, however full the buffer is; what leaves follows the fluid before it
            emptier = (plane.area * length / volume_of_rows(particles, row)).clamp(*AREA_TRUST)
            wanted = torch.where(speed < 0.0, speed * emptier, speed)
            target = scaled_profile(along - (own * plane.normal).sum(), owner, wanted, flat=self._flat)
            new = own + target[:, None] * plane.normal
            velocity = velocity.index_copy(0, row, new)
            if isinstance(lead, Tensor):
                free = free & (lead > 0.0)[particles.member]
            if not channel and (isinstance(lead, Tensor) or lead):
                velocity = with_channel_flux(particles, velocity, free, plane, speed, self._run_out)
        return particles.changed(velocity=velocity)

    def exchange(
        self, particles: Particles, clock: Clock, record: Record, pressure: Pressure, stepping: Tensor
    ) -> tuple[Particles, bool]:
        """Turn particles that have crossed an open orifice into the other kind; feed and clear the far ends."""
        if not clock.open_regions:
            return particles, False
        work = partial(self._exchanged, record=record, pressure=pressure)
        return apart(self.openings, particles, clock, work, stepping)

    def _exchanged(
        self, particles: Particles, clock: Clock, record: Record, pressure: Pressure
    ) -> tuple[Particles, bool]:
        """The same for members that see the same planes."""
        kind, gone = particles.kind, torch.zeros_like(particles.fluid)
        fresh: list[Particles] = []
        renumbered = False
        for number, plane in self.openings.active(clock):
            height, lead = plane.height(particles.position), self._lead(number, clock, particles.members)
            lead = lead[particles.member] if isinstance(lead, Tensor) else torch.full_like(height, lead)
            buffer, channel = RESERVOIR + number, CHANNEL - number
            entered = ((kind == buffer) | (kind == channel)) & (height < 0.0)
            fed = entered & (kind == buffer)
            out = self._left(kind, height, plane, particles)
            beyond = ((kind == buffer) | (kind == channel) | out) & ~entered
            turned = beyond & (lead == 0.0)
            gone_here, odd = beyond & (height > self._far), turned & (kind == channel)
            # one look at the device for all that may have happened here
            any_fed, any_odd, any_entered, any_out, any_gone = torch.stack(
                [some.any() for some in (fed, odd, entered, out, gone_here)]
            ).tolist()
            if any_fed:
                copy = particles.select(fed)
                fresh.append(copy.changed(position=copy.position + (self._far - lead[fed])[:, None] * plane.normal))
            if any_odd:
                # what drifted freely behind an outlet is no profile for the inlet that it has turned into
                inlet = turned & _of_members_with(odd, particles)
                velocity = torch.where(inlet[:, None], plane.velocity, particles.velocity)
                particles = particles.changed(velocity=velocity)
            kind = torch.where(beyond, torch.where(height < lead, channel, buffer), kind)
            kind = torch.where(entered, torch.full_like(kind, FLUID), kind)
            if any_gone:
                gone, renumbered = gone | gone_here, True
            passed = (entered if any_entered else None, out if any_out else None)
            self._account(particles, *passed, number, plane, record, pressure)
        particles = particles.changed(kind=kind)
        if not fresh and not renumbered:
            return particles, False
        particles = particles.select(~gone)
        for copy in fresh:
            particles = particles.joined(copy)
        return particles, True

    def _account(
        self,
        particles: Particles,
        entered: Tensor | None,
        left: Tensor | None,
        number: int,
        plane: OpeningPlane,
        record: Record,
        pressure: Pressure,
    ) -> None:
        """Note the particles that have ``entered`` and ``left``, (N,) bool, through an opening; None: none."""
        valve = self.openings.valve_of[number]
        if entered is not None:
            some = particles.select(entered)
            level = pressure(some)
            if particles.pressure is not None and number not in self.openings.given:
                # buffers of the incompressible scheme have none
                level = mean_near(particles, plane, pressure(particles)).index_select(0, some.member)
            note_passed(record, some, valve, level, self.units, self._density, entered=True)
        if left is not None:
            some = particles.select(left)
            note_passed(record, some, valve, pressure(some), self.units, self._density, entered=False)

    def _left(self, kind: Tensor, height: Tensor, plane: OpeningPlane, particles: Particles) -> Tensor:
        """(N,) bool: particles of the fluid that have just left through an opening."""
        out = (kind == FLUID) & (height > _HYSTERESIS) & (height < self._far)
        return self._over(out, plane, particles)

    @staticmethod
    def _over(candidates: Tensor, plane: OpeningPlane, particles: Particles) -> Tensor:
        """(N,) bool: those of the candidates (N,) bool that stand over the opening itself."""
        row = torch.nonzero(candidates).squeeze(1)
        if not row.numel():
            return candidates
        over = plane.inset(particles.position[row]) > 0
        return torch.zeros_like(candidates).index_put((row,), over)

    def beyond(self, position: Tensor, clock: Clock) -> Tensor:
        """(n,) bool: points (n, D) at an open valve or behind it."""
        beyond = super().beyond(position, clock)
        for _, plane in self.openings.active_at(clock.middle, clock):
            beyond |= plane.behind(position)
        return beyond

    def imposing_points(self, particles: Particles, clock: Clock) -> Tensor:
        """Where to look up an imposed field (N, D): fluid particles at their place, buffers just inside the orifice.

        A buffer so takes on the velocity profile that the field has at the orifice.
        """
        points = particles.position
        for number, plane in self.openings.active(clock):
            height = plane.height(points)
            inward = (-height - MOUTH)[:, None] * plane.normal
            behind = (particles.kind == RESERVOIR + number) | (particles.kind == CHANNEL - number)
            points = torch.where(behind[:, None], points + inward, points)
        return points


def _of_members_with(rows: Tensor, particles: Particles) -> Tensor:
    """(N,) bool: particles of members that have any of the rows (N,) bool."""
    return (particles.per_member(rows.to(torch.int64), "sum") > 0)[particles.member]
