"""Population control: particles that crowd are merged, holes are seeded again from what is around them.

It was asked for in Grønli 2017, sec. 5.2.

Mass and momentum only change hands: a merged particle has those of the two it replaces, a seeded one takes its share
from the particles around it.  What flows through valves is left to the reservoirs and their accounts.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from torchsph.pairs.cell_search import nearest_image
from torchsph.pairs.interface import Backend, Moments, Support
from torchsph.pairs.moving_least_squares import first_order_value
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.pairs.vectors import square_length

from .schemes.population_control import PopulationControl
from .state.particles import FLUID, Particles
from .state.record import Record
from .surroundings import PresentSurroundings
from .walls.interface import CompleteWallSample

# beyond a free surface there is nothing to seed
_UNFILLED = "population control needs fluid that fills its walls or its box; it fills {filling}"
# new particles keep this far (spacings) from walls
_CLEARANCE = 0.3
# largest share of its mass that a particle gives away at once
_LARGEST_GIFT = 0.4
# offset of the neighbours' centre of mass (smoothing lengths) beyond which a fit would extrapolate
_LARGEST_OFFSET = 0.5


class Population:
    """Controls the population of a run; internal units, all members at once."""

    def __init__(
        self,
        options: PopulationControl,
        surroundings: PresentSurroundings,
        support: Support,
        backend: Backend,
        record: Record,
    ) -> None:
        self.options, self._surroundings, self._support, self._backend = options, surroundings, support, backend
        self.domain = domain = surroundings.domain
        self._record = record
        zero = torch.zeros(1, dtype=torch.float64)
        self._peak = float(support.kernel.value(zero, support.length, support.dimension))
        self._lower = self._upper = torch.zeros(support.dimension, dtype=domain.dtype, device=domain.device)
        if domain.walls is not None:  # a particle that has got away must not make the grid of cells endless
            ends = torch.as_tensor(domain.walls.motion.vertices_at_keys, dtype=domain.dtype, device=domain.device)
            ends = ends.reshape(-1, support.dimension) / domain.units.length
            self._lower, self._upper = torch.floor(ends.amin(0)) - 1.0, ends.amax(0) + 1.0

    @classmethod
    def of(
        cls, surroundings: PresentSurroundings, backend: Backend, record: Record, particles: Particles, time: float
    ) -> Population | None:
        """The control that the domain's scheme asks for, or None.

        Raises:
            ValueError: the particles do not fill what encloses them.
        """
        domain, scheme = surroundings.domain, surroundings.domain.scheme
        if scheme.population is None:
            return None
        domain.check_filled(particles, time, _UNFILLED)
        support = Support(kernel(scheme.kernel), scheme.smoothing_ratio, domain.scene.dimension)
        return cls(scheme.population, surroundings, support, backend, record)

    def controlled_when_due(self, particles: Particles, active: Tensor) -> tuple[Particles, bool]:
        """``controlled`` in the members ``active`` (members,) bool whose turn it is."""
        due = active & (self._record.steps % self.options.every == 0)
        return self.controlled(particles, due) if bool(due.any()) else (particles, False)

    def controlled(self, particles: Particles, due: Tensor) -> tuple[Particles, bool]:
        """Merge and seed in the members where ``due`` (members,) bool; True where that has changed the set."""
        before = particles
        if self.options.closest is not None:
            particles = self._merged(particles, due, self.options.closest)
        if self.options.missing is not None:
            particles = self._seeded(particles, due, self.options.missing)
        return particles, particles is not before

    def _merged(self, particles: Particles, due: Tensor, closest: float) -> Particles:
        """Merge the pairs nearer than ``closest``: cells of twice that size, in every half-shifted arrangement."""
        edge = 2.0 * closest
        for shift in itertools.product((0.0, 0.5 * edge), repeat=particles.dimension):
            row = torch.nonzero(particles.inside & due[particles.member]).squeeze(1)
            place, cell, _ = self._cells(particles, row, edge, shift)
            order = torch.argsort(cell, stable=True)
            first, second = order[:-1], order[1:]
            near = cell[first] == cell[second]
            near &= square_length(place[first] - place[second]) < closest**2
            near &= particles.mass[row[first]] + particles.mass[row[second]] < self.options.heaviest
            # of three in a row the middle one can merge once only
            near[1:] &= ~near[:-1]
            first, second = row[first[near]], row[second[near]]
            if first.numel():
                particles = self._joined_pairs(particles, first, second)
        return particles

    def _joined_pairs(self, particles: Particles, first: Tensor, second: Tensor) -> Particles:
        """Particles ``second`` (n,) gone into ``first`` (n,): masses added, all else their mean by mass."""
        mass = particles.mass
        total = mass[first] + mass[second]
        part = mass[second] / total
        changes = {"mass": mass.index_copy(0, first, total)}
        for name in ("position", "velocity", "deviation", "pressure", "confidence", "origin"):
            value = getattr(particles, name)
            if value is None:
                continue
            difference = value[second] - value[first]
            if name in ("position", "origin"):
                difference = nearest_image(difference, self.domain.period)
            weight = part.reshape(-1, *[1] * (value.ndim - 1))
            changes[name] = value.index_copy(0, first, value[first] + weight * difference)
        keep = torch.ones_like(particles.fluid).index_fill(0, second, False)
        self._record.merged.index_add_(0, particles.member[second], torch.ones_like(second))
        return particles.changed(**changes).select(keep)

    def _cells(
        self, particles: Particles, row: Tensor, edge: float, shift: tuple[float, ...]
    ) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Places (n, D) in a frame without seams, their cells (n,), and the cells' origin, edges and numbers (D,)."""
        place = self.domain.wrapped(particles.position[row] + particles.position.new_tensor(shift))
        origin, far, period = self._lower, self._upper, self.domain.period
        size = torch.full_like(origin, edge)
        if period is not None:
            closed = torch.isfinite(period)
            whole = torch.where(closed, period, size)
            fitting = whole / torch.floor(whole / edge + 1e-3).clamp_min(1.0)
            origin, size = torch.where(closed, 0.0 * origin, origin), torch.where(closed, fitting, size)
            far = torch.where(closed, whole - 0.5 * size, far)
        counts = torch.floor((far - origin) / size).to(torch.int64) + 1
        index = torch.minimum(((place - origin) / size).to(torch.int64), counts - 1).clamp_min(0)
        cell = particles.member[row]
        for axis in range(particles.dimension):
            cell = cell * counts[axis] + index[:, axis]
        return place, cell, (origin, size, counts)

    def _seeded(self, particles: Particles, due: Tensor, missing: float) -> Particles:
        """Seed the empty cells, one spacing wide, in whose middle the kernels' sum falls short."""
        row = torch.nonzero(particles.inside).squeeze(1)
        if not row.numel():
            return particles
        place, member = self._holes(particles, row, due, missing)
        if not place.shape[0]:
            return particles
        sought = torch.zeros_like(due).index_fill(0, member, True)
        row = row[sought[particles.member[row]]]
        donors = particles.select(row)
        around = self._sums(donors, self._fields(donors), place, member)
        enough = around.count > particles.dimension
        if not bool(enough.all()):
            place, member = place[enough], member[enough]
            around = Moments(*(value[enough] for value in vars(around).values()))
        if not place.shape[0]:
            return particles
        self._record.reseeded.index_add_(0, member, torch.ones_like(member))
        return self._taken(particles, row, place, member, around)

    def _holes(self, particles: Particles, row: Tensor, due: Tensor, missing: float) -> tuple[Tensor, Tensor]:
        """Places (n, D) where particles are missing, and their members (n,)."""
        _, cell, (origin, size, counts) = self._cells(particles, row, 1.0, (0.0,) * particles.dimension)
        total = int(counts.prod())
        occupied = torch.zeros(particles.members * total, dtype=torch.bool, device=cell.device)
        occupied[cell] = True
        empty = ~occupied.reshape(particles.members, total) & due[:, None]
        number = torch.nonzero(empty.any(0)).squeeze(1)
        index: list[Tensor] = []
        left = number
        for axis in range(particles.dimension - 1, -1, -1):
            index.insert(0, left % counts[axis])
            left = left // counts[axis]
        centre = origin + (torch.stack(index, 1).to(origin.dtype) + 0.5) * size
        completeness = torch.ones_like(centre[:, 0])
        fit = torch.ones_like(number, dtype=torch.bool)
        if self.domain.walls is not None and number.numel():
            wall = self._surroundings.sample_at(centre)
            # without the kernel's completeness the sum means nothing where walls cut the kernel
            clear = self._support.radius
            if isinstance(wall, CompleteWallSample):
                clear, completeness = _CLEARANCE, wall.completeness
            fit = (wall.distance > clear) & ~self._surroundings.beyond_valves(centre)
        member, which = torch.nonzero(empty[:, number[fit]], as_tuple=True)
        centre, completeness = centre[fit][which], completeness[fit][which]
        if not member.numel():
            return centre, member
        covered = self._sums(particles, particles.mass[:, None], centre, member).value
        hole = covered < completeness * (1.0 - missing * self._peak)
        return centre[hole], member[hole]

    def _sums(self, particles: Particles, fields: Tensor, place: Tensor, member: Tensor) -> Moments:
        """Moments, weighted by mass, of ``fields`` (N, C) of particles at places (n, D) of members (n,)."""
        return self._backend.interpolate(
            particles.position,
            particles.member,
            fields,
            self._support,
            place,
            member,
            period=self.domain.period,
            weight=particles.mass,
        )

    def _fields(self, particles: Particles) -> Tensor:
        """What new particles are given by interpolation, (N, C): mass, deviation, velocity, and what else there is."""
        more = [value for value in (particles.pressure, particles.confidence) if value is not None]
        if particles.origin is not None:
            travelled = nearest_image(particles.position - particles.origin, self.domain.period)
            more = [*travelled.unbind(1), *more]
        return torch.stack([particles.mass, particles.deviation, *particles.velocity.unbind(1), *more], 1)

    def _taken(self, particles: Particles, row: Tensor, place: Tensor, member: Tensor, around: Moments) -> Particles:
        """Particles with new ones at ``place``, which those in ``row`` pay for in mass and momentum."""
        dimension, total = particles.dimension, around.value
        mean = around.field / total[:, None]
        fitted = first_order_value(around.value, around.first, around.second, around.field, around.field_first)
        offset = around.first.norm(dim=1) / total
        inner = offset < _LARGEST_OFFSET * self._support.length
        value = torch.where(inner[:, None], fitted, mean)
        mass = mean[:, 0]  # of a particle like those around
        # each neighbour gives the part (mass / total) W of its own mass, and the momentum that goes with it
        part = mass / total
        loss = self._received(particles, row, place, member, part[:, None])[:, 0]
        most = torch.zeros(particles.members, dtype=loss.dtype, device=loss.device)
        most = most.scatter_reduce(0, particles.member[row], loss, "amax")
        scale = _LARGEST_GIFT / most.clamp_min(_LARGEST_GIFT)
        mass, part = mass * scale[member], part * scale[member]
        velocity, carried = value[:, 2 : 2 + dimension], mean[:, 2 : 2 + dimension]
        back = (carried - velocity) * part[:, None]  # what the new ones do not take of it goes back
        given = self._received(particles, row, place, member, torch.cat([part[:, None], back], 1))
        kept = 1.0 - given[:, 0]
        paid = particles.changed(
            mass=particles.mass.index_copy(0, row, particles.mass[row] * kept),
            velocity=particles.velocity.index_copy(0, row, particles.velocity[row] + given[:, 1:] / kept[:, None]),
        )
        rest, origin = iter(value[:, 2 + dimension :].unbind(1)), None
        if particles.origin is not None:
            origin = place - torch.stack([next(rest) for _ in range(dimension)], 1)
        return paid.joined(
            Particles(
                place,
                velocity,
                value[:, 1],
                mass,
                member,
                torch.full_like(member, FLUID),
                particles.members,
                pressure=None if particles.pressure is None else next(rest),
                confidence=None if particles.confidence is None else next(rest).clamp_min(0.0),
                origin=origin,
            )
        )

    def _received(self, particles: Particles, row: Tensor, place: Tensor, member: Tensor, values: Tensor) -> Tensor:
        """Sum over new places of W times ``values`` (n, C), at the particles in ``row``: (len(row), C)."""
        return self._backend.interpolate(
            place,
            member,
            values,
            self._support,
            particles.position[row],
            particles.member[row],
            period=self.domain.period,
        ).field
