"""What the particles of a run see of a domain at their present times."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.vectors import per_particle

from .domain import Domain
from .state.clock import Clock
from .state.particles import Particles
from .state.record import Record
from .transfer.exchange import Exchange
from .transfer.imposing import fill_beyond
from .walls.compiled import near_wall
from .walls.displacement import WallDisplacement
from .walls.fields import STRAY
from .walls.interface import WallSample
from .walls.look_up import LookUp

# a particle this far beyond a wall (spacings) counts as outside; the soft potential is meant to be entered a little
_OUTSIDE = 0.5


class PresentSurroundings:
    """Walls, valves and body forces of a domain at the present time of every member of one run.

    ``enter`` chooses the key frames and open valves of an interval, ``at`` sets the members' times inside it.

    Attributes:
        clock: the present times.
        valve_strength: of the run, a number or (members,); what is entered from now on goes by it.
        valve_acceleration: (N, D), the last one by pressure sources, internal, for the account of their work; None
            while all valves are shut.
        exchange_field: what comes in through a plane cut out of a flow, as the last imposed field has it, or None.
        fields: of the walls in the interval; None: there are no walls, or nothing was entered yet.
        displacement: of the walls, from the next ``enter`` on; None: they are where the scene has them.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain, self.clock = domain, Clock(domain.device)
        self.valve_strength: float | Tensor = 1.0
        self.valve_acceleration: Tensor | None = None
        self.exchange_field: Exchange | None = None
        self.displacement: WallDisplacement | None = None
        self._bracket: tuple[float, float] = (0.0, 1.0)
        self._keys: tuple[Tensor, Tensor] | None = None
        self.fields: LookUp | None = None

    @property
    def entered(self) -> bool:
        """Whether there are walls to look up: an interval was entered, and the scene has some."""
        return self.fields is not None

    def enter(self, start: float, stop: float, *, shut: bool = False) -> None:
        """Choose key frames and open valves for an interval (s) without breaks inside.

        Args:
            start: s, of the interval.
            stop: s, its end.
            shut: whether every valve is kept shut.
        """
        domain, middle = self.domain, 0.5 * (start + stop)
        open_regions = () if shut else domain.open_regions(middle)
        if domain.walls is not None:
            self._bracket, keys = domain.wall_keys(middle, open_regions, self.displacement)
            if self._keys is None or keys[0] is not self._keys[0] or keys[1] is not self._keys[1]:
                self._keys, self.fields = keys, domain.walls.between(*keys)
        self.clock.enter(start, stop, open_regions, self.valve_strength)

    def at(self, times: Tensor | float) -> None:
        """Set the present time of the members, s: (members,) float64 or one for all."""
        self.clock.at(times)

    def later(self, particles: Particles, step: Tensor) -> Particles:
        """Go on by ``step`` (members,), internal; the particles with what buffers do at that time."""
        self.at(self.clock.of_members(particles.members) + step.double() * self.domain.units.time)
        if self.exchange_field is not None:
            if not self.clock.open_regions:  # nothing else can fill the walls
                self.exchange_field.wanted = self._area_rate(particles)
            particles = self.exchange_field.carried(particles)
        return self.domain.valves.driven(particles, self.clock)

    def sample(self, particles: Particles) -> WallSample | None:
        """Walls at the particles, or None."""
        if self.domain.walls is None:
            return None
        early, late = self._bracket
        fraction = torch.zeros((), dtype=self.domain.dtype, device=self.domain.device)
        if late > early:
            passed = (self.clock.times - early) / (late - early)
            fraction = passed.clamp(0.0, 1.0).to(self.domain.dtype)
            fraction = per_particle(fraction, particles.member) if fraction.ndim else fraction
        return self._look_up(particles.position, fraction)

    def sample_at(self, position: Tensor) -> WallSample:
        """Walls at points (n, D), internal, in the middle of the interval, an instant that all members have in common.

        Raises:
            ValueError: the scene has no walls.
        """
        early, late = self._bracket
        passed = (self.clock.middle - early) / (late - early) if late > early else 0.0
        fraction = torch.full((), min(max(passed, 0.0), 1.0), dtype=self.domain.dtype, device=self.domain.device)
        return self._look_up(position, fraction)

    def nearest_fluid(self, position: Tensor) -> Tensor:
        """Points (n, D), internal, with those beyond the walls moved onto them, at the present time.

        Only as far out as distances are exact: farther away nothing is known of the fluid anyway.
        """
        wall = self.sample_at(position)
        out = (-wall.distance).clamp_min(0.0)
        out = torch.where(out <= STRAY, out, torch.zeros_like(out))
        return position + out[:, None] * wall.normal

    def _look_up(self, position: Tensor, fraction: Tensor) -> WallSample:
        """Walls at points (n, D), ``fraction`` () or (n,) of the way from the earlier fields to the later ones."""
        if self.domain.walls is None or self.fields is None:
            raise ValueError("there are no walls to look up: the scene has none, or no interval was entered")
        return self.domain.walls.sample(self.fields, fraction, self.domain.wrapped(position))

    def body_force(self, particles: Particles) -> Tensor | None:
        """Acceleration (N, D) by gravity and pressure sources, or None."""
        gravity = self.domain.gravity(particles, self.clock.of_members(particles.members))
        self.valve_acceleration = self.domain.valves.acceleration(particles, self.clock)
        if self.valve_acceleration is None or gravity is None:
            return gravity if self.valve_acceleration is None else self.valve_acceleration
        return gravity + self.valve_acceleration

    def volume_deficit_rate(self, particles: Particles) -> Tensor:
        """By how much (N,), per time, the volume of a member's particles should grow to fill the cavity."""
        return per_particle(self.domain.valves.volume_deficit_rate(particles, self.clock), particles.member)

    def prepare(self, particles: Particles) -> Particles:
        """What an interval needs before its first step: buffers behind valves that have just opened."""
        return self.domain.valves.opened(particles, self.clock)

    def finish(
        self, particles: Particles, record: Record, time: float, pressure: Callable[[Particles], Tensor]
    ) -> Particles:
        """What an interval leaves behind: periodic positions wrapped, particles gone through a valve taken out."""
        if self.domain.period is not None:
            particles = particles.changed(position=self.domain.wrapped(particles.position))
        return self.domain.valves.finished(particles, self.clock, time, record, pressure)

    def exchange(
        self, particles: Particles, record: Record, pressure: Callable[[Particles], Tensor], stepping: Tensor
    ) -> tuple[Particles, bool]:
        """Pass particles between fluid and buffers; True where the particles were renumbered.

        Args:
            particles: of all members.
            record: where they are noted.
            pressure: gives p / rho0 of particles, for the account of the energy that passes.
            stepping: (members,) bool, whose particles are passed.
        """
        return self.domain.valves.exchange(particles, self.clock, record, pressure, stepping)

    def constrain(
        self, before: Particles, after: Particles, wall: WallSample | None, step: Tensor, record: Record
    ) -> Particles:
        """Keep particles inside hard walls and drive the buffers; soft potential walls need nothing.

        ``wall`` is what the particles saw before the step; its distance is carried on to first order in the step,
        which is far below a spacing, so that one look-up per step does.
        """
        scheme = self.domain.scheme
        if scheme.compressible:
            after = self.domain.valves.driven(after, self.clock)  # incompressible steps drive them half-way
        if wall is None or not scheme.wall.hard:
            return after
        gap = scheme.wall.gap
        # few particles are that close: the rest is for them alone
        near, distance = near_wall(before.position, after.position, wall, step, after.member, after.fluid, gap)
        if near.numel() == 0:
            return after
        normal = wall.normal[near]
        record.crossed_wall.index_add_(0, after.member[near], (distance < 0).to(torch.int64))
        velocity = after.velocity[near]
        towards = ((velocity - wall.velocity[near]) * normal).sum(1).clamp_max(0.0)
        work = -(after.mass[near] * towards * (normal * wall.velocity[near]).sum(1)).double() * self.domain.energy_unit
        record.wall_work.index_add_(0, after.member[near], work.nan_to_num(0.0, 0.0, 0.0))
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
        if wall is None:
            return particles.position
        distance = torch.where(wall.distance < 0, gap - wall.distance, torch.zeros_like(wall.distance))
        return particles.position.index_add(0, row, distance[:, None] * wall.normal)

    def beyond_valves(self, position: Tensor) -> Tensor:
        """(n,) bool: points (n, D), internal, at an open valve or behind it, in the middle of the interval."""
        return self.domain.valves.beyond(position, self.clock)

    def account(self, particles: Particles, record: Record, time: float, since: float) -> None:
        """Count the particles beyond the walls now, at ``time`` (s), and the volumes; the run began at ``since``."""
        self.at(time)
        wall, walls = self.sample(particles), self.domain.walls
        if wall is not None and walls is not None:
            beyond = (wall.distance < -_OUTSIDE) & particles.fluid
            record.outside = particles.per_member(beyond.to(torch.int64), "sum")
            record.filling = self.domain.filling(particles, time)
            if walls.motion.moves:
                record.cavity_change.fill_(self.domain.fluid_volume(time) - self.domain.fluid_volume(since))

    def imposed(self, particles: Particles, grid: Grid, velocity: Tensor, mask: Tensor, time: float) -> Particles:
        """Particles with the velocity of a grid field, continued beyond its mask by the walls' velocity.

        Args:
            particles: the particles.
            grid: the nodes, m.
            velocity: (D, *shape) for all members or (members, D, *shape), m/s.
            mask: (*shape) bool, where the velocity is known.
            time: s.
        """
        self.enter(time, time)
        domain = self.domain
        fields = velocity.to(domain.device, domain.dtype).reshape(-1, *velocity.shape[-grid.dimension - 1 :])
        walls = None if domain.walls is None else self._walls_in_metres
        fields = fill_beyond(fields, mask.to(domain.device), grid, walls)
        particles = domain.valves.opened(particles, self.clock)
        points = domain.valves.imposing_points(particles, self.clock)
        particles = particles.changed(velocity=self._sampled(particles, grid, fields, points))
        if domain.scene.cut:
            particles = self._exchanging(particles, grid, fields, mask.to(domain.device))
        splits = domain.valves.split_points(self.clock)
        if splits is not None:
            read = self._at_points(grid, fields, splits)
            domain.valves.note_split(read.expand(particles.members, -1, -1), self.clock)
        return domain.valves.driven(particles, self.clock, channel=True)

    def _exchanging(self, particles: Particles, grid: Grid, fields: Tensor, mask: Tensor) -> Particles:
        """Particles of a plane cut out of a flow, with what comes in through it by the fields (B, D, *shape), m/s.

        Together that is what the walls' area takes in and the openings in the plane do not pass.
        """
        domain, wanted = self.domain, self._area_rate(particles)
        points = domain.valves.open_points(self.clock)
        if wanted is not None and points is not None:
            wanted = wanted - domain.valves.through_open(self._at_points(grid, fields, points), self.clock)
        self.exchange_field = Exchange(grid, fields, mask, domain.units, domain.scene.spacing, wanted)
        return self.exchange_field.carried(particles)

    def _area_rate(self, particles: Particles) -> Tensor | None:
        """Change of the area within the walls, internal, of each member (members,); None without walls."""
        walls, units = self.domain.walls, self.domain.units
        if walls is None:
            return None
        change = walls.motion.volume_rate(self.clock.first) * units.time / units.length**walls.motion.dimension
        return torch.full((particles.members,), change, dtype=self.domain.dtype, device=self.domain.device)

    def _at_points(self, grid: Grid, fields: Tensor, points: Tensor) -> Tensor:
        """(B, n, D), internal, of fields (B, D, *shape), m/s, at points (n, D), internal."""
        place, speed = points * self.domain.units.length, self.domain.units.speed
        return torch.stack([grid.sample(field, place).T for field in fields]) / speed

    def _walls_in_metres(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (n,), positive in the fluid, and velocity (n, D), m/s, of the walls at points (n, D) float64, m."""
        wall = self.sample_at((points / self.domain.units.length).to(self.domain.dtype))
        return wall.distance, wall.velocity * self.domain.units.speed

    def _sampled(self, particles: Particles, grid: Grid, fields: Tensor, position: Tensor) -> Tensor:
        """Grid fields (members or 1, D, *shape), m/s, at points ``position`` (N, D) of particles: (N, D), internal."""
        points, speed = position * self.domain.units.length, self.domain.units.speed
        if fields.shape[0] == 1:
            return grid.sample(fields[0], points).T / speed
        parts = [grid.sample(fields[b], points[particles.member == b]).T for b in range(particles.members)]
        value = torch.empty_like(particles.velocity)
        for b, part in enumerate(parts):
            value[particles.member == b] = part
        return value / speed
