"""Open valves as openings with a buffer of particles behind them, whose flux follows from dV/dt.

The buffer is a straight channel outward of the orifice, a little longer than the kernel's support.  Its particles are
neighbours of the fluid but move with a prescribed velocity: the orifice's own, plus a profile along its normal scaled
so that the flux through the orifice equals the rate at which the cavity grows.  A buffer particle that crosses the
plane inward becomes fluid and is replaced at the far end; a fluid particle that crosses outward becomes buffer, keeps
its share of the profile, and is removed at the far end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from geometry import OrificePlane, orifices

from .particles import FLUID, RESERVOIR, Particles
from .record import Record

if TYPE_CHECKING:
    from .domain import Domain

# how far beyond the plane (spacings) an outgoing particle changes to buffer, and an incoming one to fluid
_HYSTERESIS = 0.25
# depth inside the orifice (spacings) at which the profile of an imposed field is read
_MOUTH = 0.5
# opening frames kept in memory
_KEPT_FRAMES = 64
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
        self.times, self.flux = self._flux_table()
        labels = {valve.region: number for number, valve in enumerate(self.valves)}
        # a region may consist of several openings; each has a buffer of its own
        self.openings = [one for one in orifices(self.motion) if one.label in labels]
        self.valve_of = [labels[one.label] for one in self.openings]
        self._frames: dict[tuple[int, int], _Frame] = {}

    def _flux_table(self) -> tuple[np.ndarray, np.ndarray]:
        key = np.asarray(self.motion.time)
        if len(key) == 1:
            return key, np.zeros(1)
        share = np.arange(_FLUX_SAMPLES) / _FLUX_SAMPLES
        times = np.append((key[:-1, None] + share * np.diff(key)[:, None]).ravel(), key[-1])
        unit = self.units.length**self.motion.dimension / self.units.time
        return times, np.array([self.motion.volume_rate(t) for t in times]) / unit

    def inflow(self, times: Tensor) -> Tensor:
        """dV/dt at times (s), internal: what has to enter through the open valves together."""
        wrapped = [self.domain.walls.moments.wrapped(time) for time in times.tolist()]
        value = np.interp(wrapped, self.times, self.flux)
        return torch.as_tensor(value, dtype=self.domain.dtype, device=self.domain.device)

    def frame(self, number: int) -> _Frame:
        """Opening ``number`` in the middle of the present interval (openings move little within one)."""
        time = self.domain.middle
        label = (number, int(round(time * 1e7)))
        if label not in self._frames:
            if len(self._frames) > _KEPT_FRAMES:
                self._frames.clear()
            plane = self.openings[number].at(time)
            self._frames[label] = _Frame(plane, self.units.length, self.domain.dtype, self.domain.device)
        return self._frames[label]

    def _active(self) -> list[tuple[int, _Frame]]:
        """(number, frame) of the openings of open valves."""
        chosen = self.domain.open_regions
        return [(n, self.frame(n)) for n, one in enumerate(self.openings) if one.label in chosen]

    def _flux_through(self, number: int, inflow: Tensor) -> Tensor:
        """The part of the inflow (members,) that goes through one opening.

        With several valves open at once the cavity fills through the first and empties through the last of them;
        openings of one region share by area.
        """
        regions = sorted(self.domain.open_regions)
        mine = self.openings[number].label
        part = inflow.clamp_min(0.0) * (mine == regions[0]) + inflow.clamp_max(0.0) * (mine == regions[-1])
        total = sum(frame.area for n, frame in self._active() if self.openings[n].label == mine)
        return part * (self.frame(number).area / total)

    def opened(self, particles: Particles) -> Particles:
        """Make the buffers of valves that are open and have none, drop those of valves that have shut."""
        chosen = self.domain.open_regions
        shut = [RESERVOIR + n for n, one in enumerate(self.openings) if one.label not in chosen]
        if shut:
            kind = torch.tensor(shut, device=particles.kind.device)
            stay = ~torch.isin(particles.kind, kind)
            particles = particles if bool(stay.all()) else particles.select(stay)
        for number, frame in self._active():
            has = particles.per_member((particles.kind == RESERVOIR + number).to(torch.int64), "sum") > 0
            empty = torch.nonzero(~has).squeeze(1)
            if empty.numel():
                particles = particles.joined(self._buffer(particles, number, frame, empty))
        return particles

    def _buffer(self, particles: Particles, number: int, frame: _Frame, members: Tensor) -> Particles:
        """A fresh lattice in the channel of one valve for some members."""
        place = frame.lattice(self.length)
        count, copies = place.shape[0], members.numel()
        mass = torch.stack([particles.mass[particles.member == m].mean() for m in members.tolist()])
        new = Particles(
            position=place.repeat(copies, 1), velocity=place.new_zeros((count * copies, place.shape[1])),
            deviation=self._mouth_deviation(particles, frame, members).repeat_interleave(count),
            mass=mass.repeat_interleave(count), member=members.repeat_interleave(count),
            kind=torch.full((count * copies,), RESERVOIR + number, dtype=torch.int64, device=place.device),
            members=particles.members,
        )
        return new

    @staticmethod
    def _mouth_deviation(particles: Particles, frame: _Frame, members: Tensor) -> Tensor:
        """Mean density deviation of the fluid near an orifice, per member: what a new buffer starts with."""
        near = (particles.position - frame.centre).norm(dim=1) < frame.radius
        weight = (near & particles.fluid).to(particles.deviation.dtype)
        total = particles.per_member(weight * particles.deviation, "sum")
        return (total / particles.per_member(weight, "sum").clamp_min(1.0))[members]

    def driven(self, particles: Particles) -> Particles:
        """Give the buffers' particles their velocity for the present time."""
        times = self.domain.member_times(particles.members)
        inflow = self.inflow(times)
        velocity = particles.velocity
        for number, frame in self._active():
            row = torch.nonzero(particles.kind == RESERVOIR + number).squeeze(1)
            owner, old = particles.member[row], velocity[row]
            along = (old * frame.normal).sum(1)
            own = self._orifice_velocity(frame)
            speed = -self._flux_through(number, inflow) / frame.area  # outward
            target = self._profile(along - (own * frame.normal).sum(), owner, speed, frame, particles)
            new = own + target[:, None] * frame.normal
            velocity = velocity.index_copy(0, row, new)
        return particles.changed(velocity=velocity)

    def _profile(
        self, along: Tensor, owner: Tensor, speed: Tensor, frame: _Frame, particles: Particles
    ) -> Tensor:
        """Scale the buffer's present normal velocities so that their flux is ``speed`` times the orifice's area."""
        members = speed.shape[0]
        ones = torch.ones_like(along)
        shape = ones if self.flat else along.abs()

        def total(values: Tensor) -> Tensor:
            return values.new_zeros(members).index_add(0, owner, values)

        count, sum_shape = total(ones).clamp_min(1.0), total(shape)
        mean = sum_shape / count
        flat = mean < 1e-5
        mass = particles.mass.mean()
        occupied = count * mass / self.length
        wanted = speed * (frame.area / occupied).clamp(*_AREA_TRUST)
        scale = torch.where(flat, wanted, wanted / mean.clamp_min(1e-5))
        return torch.where(flat[owner], ones, shape) * scale[owner]

    def _orifice_velocity(self, frame: _Frame) -> Tensor:
        """Velocity of the orifice itself (D,) in the present interval, from its key-frame motion."""
        if frame.velocity is None:
            frame.velocity = self.domain.sample_at(frame.centre[None]).velocity[0]
        return frame.velocity

    def exchange(self, particles: Particles, record: Record) -> tuple[Particles, bool]:
        """Turn particles that have crossed an open orifice into the other kind; feed and clear the far ends."""
        kind = particles.kind
        gone = torch.zeros_like(particles.fluid)
        fresh: list[Particles] = []
        for number, frame in self._active():
            height = frame.height(particles.position)
            label = RESERVOIR + number
            entered = (kind == label) & (height < 0.0)
            out = particles.fluid & (height > _HYSTERESIS) & (height < self.length)
            candidates = torch.nonzero(out).squeeze(1)
            if candidates.numel():
                over = frame.inset(particles.position[candidates]) > 0
                out = torch.zeros_like(out).index_put((candidates[over],), torch.ones_like(over[over]))
            far = (kind == label) & (height > self.length)
            if bool(entered.any()):
                copy = particles.select(entered)
                fresh.append(copy.changed(position=copy.position + self.length * frame.normal))
            kind = torch.where(entered, torch.full_like(kind, FLUID), kind)
            kind = torch.where(out, torch.full_like(kind, label), kind)
            gone |= far
            for counter, which in ((record.inserted, entered), (record.removed, out)):
                counter[:, self.valve_of[number]] += particles.per_member(which.to(torch.int64), "sum")
        changed = bool(fresh) or bool(gone.any())
        if not changed and kind is particles.kind:
            return particles, False
        particles = particles.changed(kind=kind)
        if not changed:
            return particles, False
        particles = particles.select(~gone)
        for copy in fresh:
            particles = particles.joined(copy)
        return particles, True

    def mouth_points(self, particles: Particles) -> Tensor:
        """Where to look up an imposed field (N, D): fluid particles at their place, buffers just inside the orifice.

        A buffer so takes on the velocity profile that the field has at the orifice.
        """
        points = particles.position
        for number, frame in self._active():
            height = frame.height(points)
            inward = (-height - _MOUTH)[:, None] * frame.normal
            points = torch.where((particles.kind == RESERVOIR + number)[:, None], points + inward, points)
        return points


class _Frame:
    """An opening in internal units on the device."""

    def __init__(self, plane: OrificePlane, length: float, dtype: torch.dtype, device: str) -> None:
        def tensor(value: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(value), dtype=dtype, device=device)

        self._plane = OrificePlane(
            plane.centroid / length, plane.normal, plane.area / length ** len(plane.basis), plane.basis,
            plane.rim / length, plane.edges,
        )
        self.centre, self.normal, self.basis = tensor(self._plane.centroid), tensor(plane.normal), tensor(plane.basis)
        self.area = float(self._plane.area)
        self.velocity: Tensor | None = None
        self.radius = float(np.linalg.norm(self._plane.outline, axis=1).max())

    def height(self, position: Tensor) -> Tensor:
        """Outward distance from the plane, (n,)."""
        return (position - self.centre) @ self.normal

    def inset(self, position: Tensor) -> Tensor:
        """In-plane distance from the rim, (n,), positive over the opening."""
        return self._plane.lateral_distance(position)

    def lattice(self, length: float) -> Tensor:
        """Unit lattice in the channel of the given length behind the opening, (n, D)."""
        reach = int(np.ceil(self.radius)) + 1
        axis = torch.arange(-reach, reach, dtype=self.centre.dtype, device=self.centre.device) + 0.5
        flat = torch.cartesian_prod(*[axis] * self.basis.shape[0]).reshape(-1, self.basis.shape[0])
        place = self.centre + flat @ self.basis
        place = place[self.inset(place) > 0]
        layers = torch.arange(int(length), dtype=place.dtype, device=place.device) + 0.5
        return (place[:, None, :] + layers[None, :, None] * self.normal).reshape(-1, self.centre.shape[0])
