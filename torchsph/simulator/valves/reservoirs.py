"""Open valves as openings with a buffer of particles behind them, whose flux follows from dV/dt.

The buffer is a straight channel outward of the orifice, a little longer than the kernel's support.  Its particles are
neighbours of the fluid but move with a prescribed velocity: the orifice's own, plus a profile along its normal scaled
so that the flux through the orifice equals the rate at which the cavity grows.  A buffer particle that crosses the
plane inward becomes fluid and is replaced at the far end; a fluid particle that crosses outward becomes buffer, keeps
its share of the profile, and is removed at the far end.  Behind an outlet the first part of the channel may be left
free: there only the flux is prescribed, by the same change of speed for all, and the profile is the flow's own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from geometry import orifices
from torchsph.pairs.vectors import per_particle

from ..state.energy import carried_energy, energy_unit
from ..state.particles import CHANNEL, FLUID, RESERVOIR, Particles
from ..state.record import Record
from .openings import Frame

if TYPE_CHECKING:
    from ..domain import Domain

# how far beyond the plane (spacings) an outgoing particle changes to buffer, and an incoming one to fluid
_HYSTERESIS = 0.25
# depth inside the orifice (spacings) at which the profile of an imposed field is read
_MOUTH = 0.5
# what stands this far (spacings) on both sides of the plane counts in part as being inside: particles come in layers
_BLEND = 1.5
# opening frames kept in memory, and the part of its area and of a spacing by which an opening may differ from its frame
_KEPT_FRAMES = 64
_AREA_CHANGE, _PLACE_CHANGE = 0.01, 0.1
# samples of dV/dt between key frames; the flux is linear between them
_FLUX_SAMPLES = 8
# the ratio of orifice area to the area that the buffer's particles stand for: beyond these bounds the buffer is being
# emptied or filled, and following it would let the flow run away
_AREA_TRUST = (0.5, 2.0)


class Reservoirs:
    """Buffers behind the valves of a scene; internal units, all members at once."""

    def __init__(self, domain: Domain) -> None:
        self.domain, self.units = domain, domain.units
        self.motion = domain.scene.walls
        self.valves = domain.scene.valves
        self.flat = domain.scheme.valve.profile == "flat"
        self.length = float(np.ceil(domain.support_radius) + 1.0)
        self.run_out = domain.scheme.valve.run_out
        self.far = self.run_out + self.length  # where the buffer ends
        self.relaxation = domain.scheme.valve.relaxation
        self._energy = energy_unit(self.units, domain.scene.fluid.density, self.motion.dimension)
        self.times, self.flux, self.volume = self._tables()
        labels = {valve.region: number for number, valve in enumerate(self.valves)}
        # a region may consist of several openings; each has a buffer of its own
        self.openings = [one for one in orifices(self.motion) if one.label in labels]
        self.valve_of = [labels[one.label] for one in self.openings]
        # openings whose flow follows from a given pressure instead (``pressure_valves``)
        self.given = [n for n, valve in enumerate(self.valve_of) if self.valves[valve].pressure is not None]
        self.pace = self._pace()
        self._frames: dict[tuple[int, int], Frame] = {}

    def _pace(self) -> float | None:
        """Time (s) in which no opening's area, or place, changes by more than this module allows; None: they rest."""
        if not self.motion.moves:
            return None
        fastest = 0.0
        for opening in self.openings:
            planes = [opening.at(float(t)) for t in self.motion.time]
            for before, after, span in zip(planes, planes[1:], np.diff(self.motion.time), strict=False):
                grown = abs(after.area / before.area - 1.0) / _AREA_CHANGE
                gone = float(np.linalg.norm(after.centroid - before.centroid)) / (_PLACE_CHANGE * self.units.length)
                fastest = max(fastest, max(grown, gone) / span)
        return 1.0 / fastest if fastest > 0.0 else None

    def _tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Times (s), dV/dt and V of the cavity, internal; V is None where the particles' volume is not held to it."""
        key = np.asarray(self.motion.time)
        share = np.arange(_FLUX_SAMPLES) / _FLUX_SAMPLES
        times = np.append((key[:-1, None] + share * np.diff(key)[:, None]).ravel(), key[-1])
        unit = self.units.length**self.motion.dimension
        rate = np.array([self.motion.volume_rate(t) for t in times]) * (self.units.time / unit)
        if self.relaxation is None:
            return times, rate, None
        return times, rate, np.array([self.motion.volume(t) for t in times]) / unit

    def _looked_up(self, table: np.ndarray, times: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        wrapped = [self.domain.walls.key_times.wrapped(time) for time in times.tolist()]
        value = np.interp(wrapped, self.times, table)
        return torch.as_tensor(value, dtype=dtype or self.domain.dtype, device=self.domain.device)

    def inflow(self, times: Tensor) -> Tensor:
        """dV/dt at times (s), internal: what has to enter through the open valves together."""
        return self._looked_up(self.flux, times)

    def _deficit(self, particles: Particles, times: Tensor) -> Tensor:
        """Volume that the particles inside fall short of the cavity's, (members,), internal.

        A particle in an open orifice counts by the part that is inside, blended in over a spacing at the rim, so that
        the sum does not jump as it crosses.
        """
        part = particles.inside.to(particles.mass.dtype)
        for _, frame in self.active():
            height = frame.height(particles.position)
            row = torch.nonzero(height.abs() < _BLEND).squeeze(1)
            over = frame.cover(particles.position[row])
            share = 0.5 - 0.5 / _BLEND * height[row]
            part = part.index_put((row,), torch.lerp(part[row], share * share * (3.0 - 2.0 * share), over))
        # in double: thousands of equal masses added in single precision drift by more than the difference
        filled = particles.per_member((part * particles.mass).double(), "sum")
        return (self._looked_up(self.volume, times, torch.float64) - filled).to(self.domain.dtype)

    def _levelled(self, particles: Particles) -> Particles:
        """Particles whose mean density deviation at the open valves is 0, in compressible schemes.

        Where the speed of all that encloses a fluid is prescribed, the percents by which sums over neighbours miss the
        volume that is swept add up, to a pressure that is the same everywhere and tells nothing but feeds disorder.
        """
        if self.domain.scheme.sound_speed is None:
            return particles
        near = torch.zeros_like(particles.inside)
        for _, frame in self.active():
            near |= (particles.position - frame.centre).square().sum(1) < frame.radius**2
        weight = torch.where(particles.inside & near, particles.mass, torch.zeros_like(particles.mass))
        total = particles.per_member(weight, "sum").clamp_min(1.0)
        mean = particles.per_member(weight * particles.deviation, "sum") / total
        return particles.changed(deviation=particles.deviation - per_particle(mean, particles.member))

    def shortfall(self, particles: Particles) -> Tensor:
        """Share of the cavity's volume, per time, that should come in for what particles lack, (members,)."""
        times = self.domain.member_times(particles.members)
        if self.relaxation is None:
            return torch.zeros_like(times, dtype=self.domain.dtype)
        return self._deficit(particles, times) / (self._looked_up(self.volume, times) * self.relaxation)

    def frame(self, number: int) -> Frame:
        """Opening ``number`` now, to within the little that it changes in ``pace``."""
        time = self.domain.now if self.pace is None else round(self.domain.now / self.pace) * self.pace
        if not self.motion.period:
            time = min(max(time, float(self.motion.time[0])), float(self.motion.time[-1]))
        label = (number, 0 if self.pace is None else int(round(time / self.pace)))
        if label not in self._frames:
            if len(self._frames) > _KEPT_FRAMES:
                self._frames.clear()
            opening = self.openings[number]
            self._frames[label] = Frame(
                opening.at(time),
                opening.velocity(time) / self.units.speed,
                self.units.length,
                self.domain.dtype,
                self.domain.device,
            )
        return self._frames[label]

    def active(self) -> list[tuple[int, Frame]]:
        """(number, frame) of the openings of open valves."""
        chosen = self.domain.open_regions
        return [(n, self.frame(n)) for n, one in enumerate(self.openings) if one.label in chosen]

    def _flux_through(self, number: int, inflow: Tensor) -> Tensor:
        """The part of the inflow (members,) that goes through one opening.

        With several valves open at once the cavity fills through the first and empties through the last of them;
        openings of one region share by area.
        """
        fills, empties = self._passes(number)
        mine = self.openings[number].label
        total = sum(frame.area for n, frame in self.active() if self.openings[n].label == mine)
        if not (fills and empties):
            inflow = inflow.clamp_min(0.0) if fills else inflow.clamp_max(0.0) if empties else torch.zeros_like(inflow)
        return inflow * (self.frame(number).area / total)

    def _passes(self, number: int) -> tuple[bool, bool]:
        """Whether the cavity fills, and whether it empties, through an opening."""
        given = {self.openings[n].label for n in self.given}
        regions = sorted(set(self.domain.open_regions) - given)
        mine = self.openings[number].label
        return mine == regions[0], mine == regions[-1]

    def _lead(self, number: int) -> float:
        """Length of the free channel before the buffer of an opening: 0 where fluid enters in the present interval."""
        if not self.run_out or number in self.given:
            return 0.0
        inflow = np.interp(self.domain.walls.key_times.wrapped(self.domain.middle), self.times, self.flux)
        return self.run_out if inflow < 0.0 and self._passes(number)[1] else 0.0

    def opened(self, particles: Particles) -> Particles:
        """Make the buffers of valves that are open and have none, drop those of valves that have shut."""
        chosen = self.domain.open_regions
        gone = [n for n, one in enumerate(self.openings) if one.label not in chosen]
        if gone:
            kind = torch.tensor([k for n in gone for k in (RESERVOIR + n, CHANNEL - n)], device=particles.kind.device)
            stay = ~torch.isin(particles.kind, kind)
            particles = particles if bool(stay.all()) else particles.select(stay)
        for number, frame in self.active():
            has = particles.per_member((particles.kind == RESERVOIR + number).to(torch.int64), "sum") > 0
            empty = torch.nonzero(~has).squeeze(1)
            if empty.numel():
                particles = particles.joined(self._buffer(particles, number, frame, empty))
        return particles

    def _buffer(self, particles: Particles, number: int, frame: Frame, members: Tensor) -> Particles:
        """A fresh lattice in the channel of one valve for some members, its first part free where fluid leaves."""
        place = frame.lattice(self.far)
        kind = torch.where(frame.height(place) < self._lead(number), CHANNEL - number, RESERVOIR + number)
        count, copies = place.shape[0], members.numel()
        # a lattice does not tile an opening: its particles share the channel's volume
        mass = place.new_full((members.numel(),), frame.area * self.far / max(count, 1))
        new = Particles(
            position=place.repeat(copies, 1),
            velocity=place.new_zeros((count * copies, place.shape[1])),
            deviation=self._mouth_mean(particles, frame, particles.deviation)[members].repeat_interleave(count),
            mass=mass.repeat_interleave(count),
            member=members.repeat_interleave(count),
            kind=kind.repeat(copies),
            members=particles.members,
        )
        return new

    @staticmethod
    def _mouth_mean(particles: Particles, frame: Frame, values: Tensor) -> Tensor:
        """Mean of ``values`` (N,) over the fluid near an orifice, (members,)."""
        near = (particles.position - frame.centre).norm(dim=1) < frame.radius
        near &= particles.fluid
        total = particles.per_member(torch.where(near, values, torch.zeros_like(values)), "sum")
        return total / particles.per_member(near.to(values.dtype), "sum").clamp_min(1.0)

    def driven(self, particles: Particles, *, channel: bool = False) -> Particles:
        """Give the buffers' particles their velocity for the present time; with ``channel`` also the free channels'."""
        times = self.domain.member_times(particles.members)
        inflow = self.inflow(times)
        active = self.active()
        held = self.relaxation is not None and not any(number in self.given for number, _ in active)
        if held and not channel:
            inflow = inflow + self._deficit(particles, times) / self.relaxation
            particles = self._levelled(particles)
        velocity = particles.velocity
        for number, frame in active:
            if number in self.given:
                continue
            mine, free = particles.kind == RESERVOIR + number, particles.kind == CHANNEL - number
            row, lead = torch.nonzero(mine | free if channel else mine).squeeze(1), self._lead(number)
            length = self.far if channel else self.far - lead
            owner, old = particles.member[row], velocity[row]
            along = (old * frame.normal).sum(1)
            own = frame.velocity
            speed = -self._flux_through(number, inflow) / frame.area  # outward
            # what enters must be what is wanted, however full the buffer is; what leaves follows the fluid before it
            share = (frame.area * length / self._volume(particles, row)).clamp(*_AREA_TRUST)
            filled = torch.where(speed < 0.0, speed * share, speed)
            target = self._profile(along - (own * frame.normal).sum(), owner, filled)
            new = own + target[:, None] * frame.normal
            velocity = velocity.index_copy(0, row, new)
            if lead and not channel:
                velocity = self._carried(particles, velocity, free, frame, speed)
        return particles.changed(velocity=velocity)

    def _carried(self, particles: Particles, velocity: Tensor, free: Tensor, frame: Frame, speed: Tensor) -> Tensor:
        """Velocities (N, D), in the free channel, ``free`` (N,) bool, with a mean that carries area times ``speed``.

        A pressure gradient along a straight channel speeds up all of it alike. The solver knows of none at the buffer,
        and would leave the channel, and with it the flow that ends there, several steps behind. Volume is what counts,
        not the mean speed: a jet that leaves the channel's walls is thinner and faster than the channel.
        """
        row = torch.nonzero(free).squeeze(1)
        if not row.numel():
            return velocity
        owner, height = particles.member[row], frame.height(particles.position[row])
        # layers come and go at the ends of the channel: they count less there
        weight = particles.mass[row] * height.clamp(0.0, 1.0) * (self.run_out - height).clamp(0.0, 1.0)
        along = ((velocity[row] - frame.velocity) * frame.normal).sum(1)

        def total(values: Tensor) -> Tensor:
            return torch.zeros_like(speed).index_add(0, owner, values)

        held = total(weight).clamp_min(1e-6)
        # an opening that narrows leaves behind it more than it holds; that flows no slower
        thinner = (frame.area * (self.run_out - 1.0) / held).clamp(1.0, _AREA_TRUST[1])
        missing = speed * thinner - total(weight * along) / held
        return velocity.index_add(0, row, missing[owner][:, None] * frame.normal)

    @staticmethod
    def _volume(particles: Particles, row: Tensor) -> Tensor:
        """Volume of the particles in ``row`` of each member, (members,)."""
        mass = particles.mass[row]
        total = mass.new_zeros(particles.members).index_add(0, particles.member[row], mass)
        return total.clamp_min(float(particles.mass.mean()) if particles.count else 1.0)

    def _profile(self, along: Tensor, owner: Tensor, speed: Tensor) -> Tensor:
        """Scale present normal velocities (n,) so that each member's mean is ``speed`` (members,); flat without any."""
        ones, forward = torch.ones_like(along), along * speed.sign()[owner]
        shape = forward.clamp_min(0.0)

        def total(values: Tensor) -> Tensor:
            return torch.zeros_like(speed).index_add(0, owner, values)

        count = total(ones).clamp_min(1.0)
        # what stood still, or flowed the other way until now, has no profile
        flat = (total(forward) / count < 0.25 * speed.abs()) | self.flat
        scale = torch.where(flat, speed, speed / (total(shape) / count).clamp_min(1e-5))
        return torch.where(flat[owner], ones, shape) * scale[owner]

    def exchange(
        self, particles: Particles, record: Record, pressure: Callable[[Particles], Tensor]
    ) -> tuple[Particles, bool]:
        """Turn particles that have crossed an open orifice into the other kind; feed and clear the far ends."""
        kind, gone, fresh = particles.kind, torch.zeros_like(particles.fluid), []
        for number, frame in self.active():
            height, lead = frame.height(particles.position), self._lead(number)
            buffer, channel = RESERVOIR + number, CHANNEL - number
            entered = ((kind == buffer) | (kind == channel)) & (height < 0.0)
            fed = entered & (kind == buffer)
            if bool(fed.any()):
                copy = particles.select(fed)
                fresh.append(copy.changed(position=copy.position + (self.far - lead) * frame.normal))
            out = self._left(kind, height, frame, particles)
            beyond = ((kind == buffer) | (kind == channel) | out) & ~entered
            if not lead and bool((beyond & (kind == channel)).any()):
                # what drifted freely behind an outlet is no profile for the inlet that it has turned into
                velocity = torch.where(beyond[:, None], frame.velocity, particles.velocity)
                particles = particles.changed(velocity=velocity)
            kind = torch.where(beyond, torch.where(height < lead, channel, buffer), kind)
            kind = torch.where(entered, torch.full_like(kind, FLUID), kind)
            gone |= beyond & (height > self.far)
            valve, unit = self.valve_of[number], self.units.length**self.motion.dimension
            for counter, volume, energy, which in (
                (record.inserted, record.inflow, record.energy_in, entered),
                (record.removed, record.outflow, record.energy_out, out),
            ):
                if not bool(which.any()):
                    continue
                some = particles.select(which)
                level = pressure(some)
                if which is entered and particles.pressure is not None and number not in self.given:
                    # buffers of the incompressible scheme have none
                    level = self._mouth_mean(particles, frame, pressure(particles)).index_select(0, some.member)
                counter[:, valve] += some.per_member(torch.ones_like(some.member), "sum")
                volume[:, valve] += some.per_member(some.mass.double(), "sum") * unit
                energy[:, valve] += some.per_member(carried_energy(some, level), "sum") * self._energy
        particles = particles.changed(kind=kind)
        if not fresh and not bool(gone.any()):
            return particles, False
        particles = particles.select(~gone)
        for copy in fresh:
            particles = particles.joined(copy)
        return particles, True

    def _left(self, kind: Tensor, height: Tensor, frame: Frame, particles: Particles) -> Tensor:
        """(N,) bool: particles of the fluid that have just left through an opening."""
        out = (kind == FLUID) & (height > _HYSTERESIS) & (height < self.far)
        return self._over(out, frame, particles)

    @staticmethod
    def _over(candidates: Tensor, frame: Frame, particles: Particles) -> Tensor:
        """(N,) bool: those of the candidates (N,) bool that stand over the opening itself."""
        row = torch.nonzero(candidates).squeeze(1)
        if not row.numel():
            return candidates
        over = frame.inset(particles.position[row]) > 0
        return torch.zeros_like(candidates).index_put((row,), over)

    def mouth_points(self, particles: Particles) -> Tensor:
        """Where to look up an imposed field (N, D): fluid particles at their place, buffers just inside the orifice.

        A buffer so takes on the velocity profile that the field has at the orifice.
        """
        points = particles.position
        for number, frame in self.active():
            height = frame.height(points)
            inward = (-height - _MOUTH)[:, None] * frame.normal
            mine = (particles.kind == RESERVOIR + number) | (particles.kind == CHANNEL - number)
            points = torch.where(mine[:, None], points + inward, points)
        return points
