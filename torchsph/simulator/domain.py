"""The world around the particles during a run: walls, valves, forces and periodic sides, in internal units."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.pairs.vectors import per_particle

from .imposing import fill_beyond
from .scene import Scene
from .schemes.presets import Scheme
from .schemes.valve_models import PressureSource, Reservoir
from .schemes.wall_models import CompleteKernelWall
from .state.energy import energy_unit
from .state.particles import Particles
from .state.record import Record
from .state.units import Units
from .walls.compiled import near_wall
from .walls.fields import WallFields
from .walls.interface import WallSample
from .walls.look_up import LookUp

# a particle this far beyond a wall (spacings) counts as outside; the soft potential is meant to be entered a little
_OUTSIDE = 0.5


class Domain:
    """Walls, valves and body forces at the present time of every member.

    ``enter`` chooses the key frames and open valves of an interval, ``at`` sets the members' times inside it.
    """

    def __init__(self, scene: Scene, scheme: Scheme, units: Units, device: str, dtype: torch.dtype) -> None:
        self.scene, self.scheme, self.units = scene, scheme, units
        self.device, self.dtype = device, dtype
        smoothing = kernel(scheme.kernel)
        self._energy = energy_unit(units, scene.fluid.density, scene.dimension)
        self.support_radius = smoothing.support * scheme.smoothing_ratio
        self.period = self._period()
        self._steady_gravity = None
        if scene.gravity is not None and not callable(scene.gravity):
            self._steady_gravity = self._acceleration([scene.gravity])
        self.walls: WallFields | None = None
        self.sources = self.reservoirs = None
        self._open: tuple[int, ...] = ()
        self._bracket: tuple[float, float] = (0.0, 1.0)
        self._keys: tuple[Tensor, Tensor] | None = None
        self._fields: LookUp | None = None
        self._times: Tensor | None = None
        if scene.walls is not None:
            complete = isinstance(scheme.wall, CompleteKernelWall)
            self._check_periodic_walls()
            self.walls = WallFields(
                scene.walls,
                units.length,
                units.speed,
                smoothing,
                scheme.smoothing_ratio,
                complete,
                device,
                dtype,
                sliding=complete and scheme.wall.sliding,
            )
            self._make_valves()

    def _make_valves(self) -> None:
        from .valves.pressure_sources import Sources
        from .valves.reservoirs import Reservoirs  # here, because reservoirs need the domain's wall fields

        given = [valve.region for valve in self.scene.valves if valve.pressure is not None]
        if given and isinstance(self.scheme.valve, PressureSource):
            raise ValueError(f"valves at a given pressure (regions {given}) need Reservoir, not PressureSource")
        if self.scene.valves and isinstance(self.scheme.valve, PressureSource):
            self.sources = Sources(self.scene, self.scheme.valve, self.units, self.device, self.dtype)
        if self.scene.valves and isinstance(self.scheme.valve, Reservoir):
            self.reservoirs = Reservoirs(self)

    def _period(self) -> Tensor | None:
        if self.scene.period is None:
            return None
        lengths = [float("inf") if p is None else p / self.units.length for p in self.scene.period]
        return torch.tensor(lengths, dtype=self.dtype, device=self.device)

    def _check_periodic_walls(self) -> None:
        """Walls of a periodic scene must reach past both ends, because what a particle sees is looked up inside.

        Raises ValueError where they end within a kernel of the periodic box.
        """
        reach = (self.support_radius + 1.0) * self.units.length
        for axis, length in enumerate(self.scene.period or ()):
            if length is None:
                continue
            ends = self.scene.walls.vertices_at_keys[..., axis]
            if ends.min() > -reach or ends.max() < length + reach:
                raise ValueError(
                    f"axis {axis} is periodic over {length:g} m, but the walls span only {ends.min():g} to "
                    f"{ends.max():g} m there; continue them unchanged at least {reach:g} m past both ends"
                )

    def fluid_volume(self, time: float) -> float:
        """Volume (area in a plane) that the walls enclose in one period, m^D."""
        motion = self.scene.walls
        volume, vertices = motion.volume(time), motion.vertices(time)
        for axis, length in enumerate(self.scene.period or ()):
            if length is not None:
                volume *= length / (vertices[:, axis].max() - vertices[:, axis].min())
        return volume

    def filling(self, particles: Particles, time: float) -> Tensor:
        """Volume of the particles inside over that of the walls, or of the periodic box, (members,) float64.

        0 where nothing encloses them.
        """
        inside = particles.per_member((particles.mass * particles.inside).double(), "sum")
        if self.walls is not None:
            return inside * self.units.length**particles.dimension / self.fluid_volume(time)
        if self.period is not None:
            return inside / self.period.double().prod()
        return torch.zeros_like(inside)

    def breaks(self, start: float, stop: float) -> list[float]:
        """The times in (start, stop] at which members meet: key frames, valve events, and ``stop``."""
        times = {stop}
        if self.walls is not None:
            times.update(self.walls.key_times.within(start, stop))
        if self.scheme.valve is not None:
            times.update(t for valve in self.scene.valves for t in valve.events(start, stop))
        tolerance = 1e-9 * max(1.0, abs(stop))
        inner = sorted(t for t in times if start + tolerance < t < stop - tolerance)
        return [*inner, stop] if stop > start else []

    def enter(self, start: float, stop: float, *, shut: bool = False, valve_strength: float | Tensor = 1.0) -> None:
        """Choose key frames and open valves for an interval without breaks inside; ``shut`` closes every valve.

        ``valve_strength``: of the run that goes through it, a number or (members,).
        """
        self.valve_strength = valve_strength
        middle = 0.5 * (start + stop)
        self._open = ()
        if self.scheme.valve is not None and not shut:
            self._open = tuple(v.region for v in self.scene.valves if v.is_open(middle))
        self.middle = middle  # s, of the present interval
        if self.walls is not None:
            early, late, *bracket = self.walls.key_times.bracket(middle)
            self._bracket = (bracket[0], bracket[1])
            keys = (self.walls.key(early, self._open), self.walls.key(late, self._open))
            if self._keys is None or keys[0] is not self._keys[0] or keys[1] is not self._keys[1]:
                self._keys, self._fields = keys, self.walls.between(*keys)
        self.at(start)

    def prepare_until(self, start: float, stop: float) -> None:
        """Make the wall fields of a stretch of time (s) beforehand, so that the steps find them."""
        ends = self.breaks(start, stop)
        for early, late in zip([start, *ends], ends, strict=False):
            self.enter(early, late)

    @property
    def open_regions(self) -> tuple[int, ...]:
        """Regions of the valves that are open in the present interval."""
        return self._open

    def at(self, times: Tensor | float) -> None:
        """Set the present time of the members, s: (members,) float64 or one for all."""
        self._times = torch.as_tensor(times, dtype=torch.float64, device=self.device)
        self._now: float | None = None

    @property
    def now(self) -> float:
        """Present time, s, on the average over the members."""
        if self._now is None:
            self._now = float(self._times.mean())
        return self._now

    def later(self, particles: Particles, step: Tensor) -> Particles:
        """Go on by ``step`` (members,), internal; the particles with what buffers do at that time."""
        self.at(self.member_times(particles.members) + step.double() * self.units.time)
        return self.reservoirs.driven(particles) if self.reservoirs is not None and self._open else particles

    def time_of(self, particles: Particles) -> Tensor:
        """Present time of each particle's member, s, (N,) float64."""
        return self.member_times(particles.members).index_select(0, particles.member)

    def member_times(self, members: int) -> Tensor:
        """Present time of each member, s, (members,) float64."""
        return self._times.expand(members) if self._times.ndim == 0 else self._times

    def sample(self, particles: Particles) -> WallSample | None:
        """Walls at the particles, or None."""
        if self.walls is None:
            return None
        early, late = self._bracket
        fraction = torch.zeros((), dtype=self.dtype, device=self.device)
        if late > early:
            share = (self._times - early) / (late - early)
            fraction = share.clamp(0.0, 1.0).to(self.dtype)
            fraction = per_particle(fraction, particles.member) if fraction.ndim else fraction
        return self.walls.sample(self._fields, fraction, self.wrapped(particles.position))

    def sample_at(self, position: Tensor) -> WallSample:
        """Walls at points (n, D), internal, at the present time (one for all members)."""
        early, late = self._bracket
        share = float((self._times.max() - early) / (late - early)) if late > early else 0.0
        fraction = torch.full((), min(max(share, 0.0), 1.0), dtype=self.dtype, device=self.device)
        return self.walls.sample(self._fields, fraction, self.wrapped(position))

    def body_force(self, particles: Particles) -> Tensor | None:
        """Acceleration (N, D) by gravity and pressure sources, or None."""
        total = self._gravity(particles)
        push = None
        if self.sources is not None:
            push = self.sources.acceleration(particles, self._open, self.time_of(particles), self.valve_strength)
        if push is None or total is None:
            return total if push is None else push
        return total + push

    def shortfall(self, particles: Particles) -> Tensor:
        """By how much (N,), per time, the volume of a member's particles should grow to fill the cavity."""
        return per_particle(self.reservoirs.shortfall(particles), particles.member)

    def _gravity(self, particles: Particles) -> Tensor | None:
        """Gravity at the particles' present times (N, D) or None."""
        if self._steady_gravity is not None:
            return self._steady_gravity.expand_as(particles.position)
        if self.scene.gravity is None:
            return None
        times = self.member_times(particles.members).tolist()
        return self._acceleration([self.scene.gravity_at(t) for t in times]).index_select(0, particles.member)

    def _acceleration(self, rows: list[tuple[float, ...]]) -> Tensor:
        """Rows (n, D), m/s^2, as internal accelerations."""
        return torch.tensor(rows, dtype=self.dtype, device=self.device) / self.units.acceleration

    def prepare(self, particles: Particles) -> Particles:
        """What an interval needs before its first step: buffers behind valves that have just opened."""
        return particles if self.reservoirs is None else self.reservoirs.opened(particles)

    def finish(
        self, particles: Particles, record: Record, time: float, pressure: Callable[[Particles], Tensor]
    ) -> Particles:
        """What an interval leaves behind: periodic positions wrapped, particles gone through a valve taken out."""
        particles = self._wrapped(particles)
        if self.sources is None:
            return particles
        return self.sources.without_gone(particles, self._open, time, record, pressure)

    def exchange(
        self, particles: Particles, record: Record, pressure: Callable[[Particles], Tensor]
    ) -> tuple[Particles, bool]:
        """Pass particles between fluid and buffers; True where the particles were renumbered.

        ``pressure`` gives p / rho0 of particles, for the account of the energy that passes.
        """
        if self.reservoirs is None or not self._open:
            return particles, False
        return self.reservoirs.exchange(particles, record, pressure)

    def constrain(
        self, before: Particles, after: Particles, wall: WallSample | None, step: Tensor, record: Record
    ) -> Particles:
        """Keep particles inside hard walls and drive the buffers; soft potential walls need nothing.

        ``wall`` is what the particles saw before the step; its distance is carried on to first order in the step,
        which is far below a spacing, so that one look-up per step does.
        """
        if self.reservoirs is not None and self._open and self.scheme.sound_speed is not None:
            after = self.reservoirs.driven(after)  # incompressible steps drive them half-way
        if wall is None or not isinstance(self.scheme.wall, CompleteKernelWall):
            return after
        gap = self.scheme.wall.gap
        # few particles are that close: the rest is for them alone
        near, distance = near_wall(before.position, after.position, wall, step, after.member, after.fluid, gap)
        if near.numel() == 0:
            return after
        normal = wall.normal[near]
        record.crossed_wall.index_add_(0, after.member[near], (distance < 0).to(torch.int64))
        velocity = after.velocity[near]
        towards = ((velocity - wall.velocity[near]) * normal).sum(1).clamp_max(0.0)
        done = -(after.mass[near] * towards * (normal * wall.velocity[near]).sum(1)).double() * self._energy
        record.wall_work.index_add_(0, after.member[near], done.nan_to_num(0.0, 0.0, 0.0))
        position = after.position.index_add(0, near, (gap - distance)[:, None] * normal)
        velocity = after.velocity.index_add(0, near, -towards[:, None] * normal)
        crossed = near[distance < 0]
        if crossed.numel():
            position = self._pushed_back(after.changed(position=position), crossed, gap)
        return after.changed(position=position, velocity=velocity)

    def _pushed_back(self, particles: Particles, row: Tensor, gap: float) -> Tensor:
        """Positions (N, D) with those of ``row`` (n,) that are still beyond a wall put before it.

        At an edge what one wall pushes back may end behind the other, and a step may lead past where a distance
        carried on to first order holds: so these few look again.
        """
        wall = self.sample(particles.select(row))
        way = torch.where(wall.distance < 0, gap - wall.distance, torch.zeros_like(wall.distance))
        return particles.position.index_add(0, row, way[:, None] * wall.normal)

    def _wrapped(self, particles: Particles) -> Particles:
        return particles if self.period is None else particles.changed(position=self.wrapped(particles.position))

    def wrapped(self, position: Tensor) -> Tensor:
        """Points (n, D), internal, brought back into the periodic box."""
        if self.period is None:
            return position
        finite = torch.isfinite(self.period)
        length = torch.where(finite, self.period, torch.ones_like(self.period))
        return torch.where(finite, torch.remainder(position, length), position)

    def shortest(self, way: Tensor) -> Tensor:
        """Differences (n, D) of positions, internal, the shortest way around the periodic box."""
        if self.period is None:
            return way
        finite = torch.isfinite(self.period)
        length = torch.where(finite, self.period, torch.ones_like(self.period))
        return torch.where(finite, way - length * torch.round(way / length), way)

    def beyond_valves(self, position: Tensor) -> Tensor:
        """(n,) bool: points (n, D), internal, at an open valve or behind it, where the walls' distance knows no end."""
        beyond = torch.zeros_like(position[:, 0], dtype=torch.bool)
        if self.reservoirs is not None:
            for _, frame in self.reservoirs.active():
                beyond |= frame.behind(position)
        if self.sources is not None:
            for region in self._open:
                beyond |= self.sources.behind(position, region, self.middle)
        return beyond

    def account(self, particles: Particles, record: Record, time: float, since: float) -> None:
        """Count the particles beyond the walls now, at ``time`` (s), and the volumes; the run began at ``since``."""
        self.at(time)
        wall = self.sample(particles)
        if wall is not None:
            beyond = (wall.distance < -_OUTSIDE) & particles.fluid
            record.outside = particles.per_member(beyond.to(torch.int64), "sum")
            record.filling = self.filling(particles, time)
            if self.scene.walls.moves:
                record.cavity_change.fill_(self.fluid_volume(time) - self.fluid_volume(since))

    def imposed(self, particles: Particles, grid: Grid, velocity: Tensor, mask: Tensor, time: float) -> Particles:
        """Particles with the velocity of a grid field, continued beyond its mask by the walls' velocity."""
        self.enter(time, time)
        lead = velocity.to(self.device, self.dtype).reshape(-1, *velocity.shape[-grid.dimension - 1 :])
        field = fill_beyond(lead, mask.to(self.device), grid, self)
        if self.reservoirs is not None:
            particles = self.reservoirs.opened(particles)
            points = self.reservoirs.mouth_points(particles)
        else:
            points = particles.position
        particles = particles.changed(velocity=self.sampled(particles, grid, field, points))
        return particles if self.reservoirs is None else self.reservoirs.driven(particles, channel=True)

    def sampled(self, particles: Particles, grid: Grid, field: Tensor, position: Tensor | None = None) -> Tensor:
        """A grid field (members or 1, D, *shape), m/s, at the particles or at ``position``: (N, D), internal."""
        points = (particles.position if position is None else position) * self.units.length
        field = field.to(self.device, self.dtype)
        field = field if field.ndim == grid.dimension + 2 else field[None]
        if field.shape[0] == 1:
            return grid.sample(field[0], points).T / self.units.speed
        parts = [grid.sample(field[b], points[particles.member == b]).T for b in range(particles.members)]
        value = torch.empty_like(particles.velocity)
        for b, part in enumerate(parts):
            value[particles.member == b] = part
        return value / self.units.speed
