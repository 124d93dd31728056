"""A running simulation: a batch of members on their way through time, with what they did and what went wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.interface import Backend
from torchsph.pairs.moving_least_squares import Fetched, fetch_at

from .domain import Domain
from .imposing import pulled
from .population import Population
from .rollback import Checkpoints
from .scene import Scene
from .schemes.scheme import Scheme
from .state.neighbour_list import PairSearch
from .state.particles import Particles, held, held_rows
from .state.record import Record
from .stepping.coefficients import Coefficients, Parameters
from .stepping.pressure import Neighbourhood, divergence_free
from .stepping.step_length import StepControl
from .stepping.stepper import make_stepper
from .surroundings import PresentSurroundings
from .work import WorkAccount

# how far particles move before the neighbours are searched again, in spacings
_SEARCH_MARGIN = 0.25
# from so many particles on they are sorted in space, every so many searches: smaller sets fit into the caches anyway
_SORT_FROM, _SORT_EVERY = 50_000, 8
# a member that would need more steps than this for the rest of an interval has broken down
_MOST_STEPS = 1e7
# support radius of the fetching weight, in spacings
FETCH_RADIUS = 2.0


# particles that fill less of their walls leave a free surface
_LEAST_FILLING = 0.9


def check_filled(domain: Domain, particles: Particles, time: float) -> None:
    """ValueError where fluid does not fill its walls, or its box, though the scheme knows of no free surface."""
    if not domain.scheme.must_fill or particles.count == 0:
        return
    filling = float(domain.filling(particles, time).min())
    if filling < _LEAST_FILLING:
        raise ValueError(
            f"the particles fill {100 * filling:.0f} % of what encloses them, so the fluid has a free surface: give "
            "Projection(surface=0.85), or step with the weakly compressible scheme"
        )


class NumericalFailure(RuntimeError):
    """Every member of a run has failed; the record says how far each came."""


class Model(Protocol):
    """What runs come from (``Simulator``)."""

    @property
    def scene(self) -> Scene:
        """What is simulated."""

    @property
    def scheme(self) -> Scheme:
        """How it is stepped."""

    @property
    def backend(self) -> str:
        """Name of the pair backend."""

    @property
    def device(self) -> str:
        """Where particles live."""

    def resume(self, particles: Particles, time: float) -> Simulation:
        """Another run, from given particles on."""


class Simulation:
    """A batch of members on their way through time.  Particles and record change; the domain does not.

    Attributes:
        simulator: what the run comes from, where a ``Simulator`` has made it.
        domain: walls, valves and forces.
        surroundings: what particles see of them at their present times.
        units: internal units.
        particles: the flat set of all members, internal units.
        parameters: the numbers of the scheme in use; see ``change``.
        record: accounts of the run.
        time: present time, s.
    """

    simulator: Model

    def __init__(self, domain: Domain, backend: Backend, particles: Particles, time: float) -> None:
        self.domain, self.units, self.particles, self.time = domain, domain.units, particles, float(time)
        self.surroundings, self._backend = PresentSurroundings(domain), backend
        scene, scheme = domain.scene, domain.scheme
        self.record = Record(particles.members, len(scene.valves), particles.position.device)
        self.parameters = Parameters.of(scheme, scene.fluid.viscosity)
        self._coefficients = Coefficients.of(self.parameters, self.units, scene.fluid.density)
        # incompressible steps see their neighbours once; lists of that moment also make them independent of a batch
        margin = _SEARCH_MARGIN if scheme.compressible else 0.0
        search = PairSearch(self._backend, self.domain.support_radius, margin, self.domain.period)
        check_filled(domain, particles, self.time)
        buffered = domain.valves.has_buffers
        self._stepper = make_stepper(
            scheme, self._coefficients, search, scene.dimension, self.record, buffered=buffered
        )
        self._control = StepControl(self.record, scheme.step_floor)
        self._work = WorkAccount.of(domain, self.record)
        self._population = Population.of(self.surroundings, self._backend, self.record, particles, self.time)
        self._pressures = domain.valves.pressure_reservoirs(self._backend)
        if self._pressures is not None:
            self._stepper.prescribed_kinds = self._pressures.kinds
        self._acceleration = torch.zeros_like(particles.position)
        self._began_at = self._imposed_at = self.time
        self._order: Tensor | None = None  # of the particles in space when they were last sorted
        self._sort_at = 0  # number of searches at which they are sorted again

    @property
    def members(self) -> int:
        """Number of members, failed ones included."""
        return self.particles.members

    def advance(self, until: float) -> None:
        """Step every member that has not failed to time ``until`` (s), each with its own time step.

        Raises NumericalFailure when no member is left; a member that fails before is frozen and flagged.
        """
        if until < self.time:
            raise ValueError(f"cannot advance backwards, from {self.time} s to {until} s")
        if until == self.time:
            return
        self._fail_lost()
        if self.particles.count >= _SORT_FROM:
            self.particles = self.particles.labelled()
            self._sort(self._order)
        longest = self._longest_step(until)
        for stop in self.domain.breaks(self.time, until):
            self.surroundings.enter(self.time, stop, valve_strength=self.parameters.valve_strength)
            self.particles = self.surroundings.prepare(self.particles)
            self._forget_pairs()
            self._advance_interval(stop, longest)
            self.time = stop
            self.particles = self.surroundings.finish(self.particles, self.record, stop, self._stepper.pressure)
            self._forget_pairs()
        self._unsort()
        self.record.searches = self._stepper.pair_search.searches
        self.record.overflows = self._backend.overflows
        self.surroundings.account(self.particles, self.record, self.time, self._began_at)

    def _longest_step(self, until: float) -> float:
        """Limit of the steps to time ``until`` (s) that the scheme names outright, internal."""
        scheme = self.domain.scheme
        longest = (until - self.time) / (scheme.steps_per_frame or 1)
        if scheme.max_step is not None:
            longest = min(longest, scheme.max_step)
        return longest / self.units.time

    def change(self, **values: float | Sequence[float] | Tensor | None) -> None:
        """Change parameters from now on: one number for all members, or a row (members,) with one for each.

        Names are those of ``Parameters``; None switches a term off. Raises ValueError where a value cannot be, or
        where the scheme has no place for it.
        """
        scheme = self.domain.scheme
        if scheme.changeable is not None and not set(values) <= set(scheme.changeable):
            known = ", ".join(scheme.changeable)
            raise ValueError(f"of the incompressible scheme only {known} can change, got {list(values)}")
        if values.get("xsph") is not None and scheme.xsph is None:
            raise ValueError("parameter 'xsph' needs a scheme with XSPH, which says of what level and form it is")
        if "valve_strength" in values and not self.domain.valves.takes_strength:
            raise ValueError("parameter 'valve_strength' needs pressure sources or valves that are given a pressure")
        if "smoothing_ratio" in values and self.domain.walls is not None and scheme.wall.complete:
            raise ValueError("the tables of a complete-kernel wall are made for the scheme's smoothing_ratio")
        self.parameters = self.parameters.changed(self.particles.velocity, self.members, **values)
        self._coefficients = Coefficients.of(self.parameters, self.units, self.domain.scene.fluid.density)
        self._stepper.use(self._coefficients)
        self._stepper.pair_search.radius = self._stepper.support.radius
        self._forget_pairs()

    def _advance_interval(self, stop: float, longest: float) -> None:
        duration = (stop - self.time) / self.units.time
        done = torch.zeros(self.members, dtype=torch.float64, device=self.particles.position.device)
        options = self.domain.scheme.rollback
        checkpoints = None if options is None else Checkpoints(options, self.record)
        while True:
            left = torch.where(self.record.failed, torch.zeros_like(done), duration - done)
            left = torch.where(left > 1e-9 * duration, left, torch.zeros_like(left))
            if not bool((left > 0).any()):
                return
            if checkpoints is not None:
                checkpoints.keep(self.particles, self._acceleration, done)
            self._ramp(done)
            step = self._control.step(
                self.particles,
                self._acceleration,
                self._stepper.coefficients,
                left,
                longest,
                None if checkpoints is None else checkpoints.factor,
            )
            hopeless = (left > 0) & (step * _MOST_STEPS < left)
            if bool(hopeless.any()):
                self._fail(hopeless)
                continue
            self.surroundings.at(self.time + done * self.units.time)
            self._pass_valves()
            if self._population is not None:
                self._control_population(step > 0)
            if self._pressures is not None:
                self.particles = self._pressures.driven(self.particles, self.surroundings.clock, self._stepper)
            self._sort_when_due()
            done = self._take_step(step, done, checkpoints)

    def _ramp(self, done: Tensor) -> None:
        """Let gamma grow, where the scheme has it grow."""
        ramp = self.domain.scheme.gamma_ramp
        if ramp is None:
            return
        elapsed = self.time - self._imposed_at + done * self.units.time
        ramped = self._coefficients
        if bool((elapsed < ramp.duration).any()):
            ramped = ramped.ramped(ramp, elapsed.to(self.particles.position.dtype))
        if ramped is not self._stepper.coefficients:
            self._stepper.use(ramped)

    def _pass_valves(self) -> None:
        """Particles that have crossed an open valve change sides, in every step: the flow must not feel the search."""
        self.particles, renumbered = self.surroundings.exchange(self.particles, self.record, self._stepper.pressure)
        if renumbered:
            self._forget_pairs()

    def _control_population(self, active: Tensor) -> None:
        """Merge and seed particles in the members (members,) bool whose turn it is."""
        due = active & (self.record.steps % self._population.options.every == 0)
        if not bool(due.any()):
            return
        self.particles, changed = self._population.controlled(self.particles, due)
        if changed:
            self._forget_pairs()

    def _sort_when_due(self) -> None:
        """Now and then, where the neighbours are to be searched anyway, sort large sets in space."""
        search = self._stepper.pair_search
        due = self.particles.count >= _SORT_FROM and search.searches >= self._sort_at
        if due and search.stale(self.particles):
            self._sort(search.spatial_order(self.particles))
            self._sort_at = search.searches + _SORT_EVERY

    def _sort(self, order: Tensor | None) -> None:
        """Put the particles into an order (N,) with labels that tell the caller's; nothing where it does not fit."""
        if order is None or len(order) != self.particles.count:
            return
        particles = self.particles if self.particles.label is not None else self.particles.labelled()
        self.particles = particles.select(order)
        self._acceleration = self._acceleration[order]
        self._stepper.pair_search.forget()

    def _unsort(self) -> None:
        """Back to the caller's order; the order in space is kept for the next time."""
        label = self.particles.label
        self._order = None
        if label is None:
            return
        back = torch.argsort(label, stable=True)
        self._order = torch.argsort(back)
        self.particles, self._acceleration = self.particles.by_label(), self._acceleration[back]

    def _take_step(self, step: Tensor, done: Tensor, checkpoints: Checkpoints | None) -> Tensor:
        """Step every member by its own ``step`` (members,); how far each has come in the interval (members,)."""
        before, push = self.particles, self._acceleration
        inner = step.to(before.position.dtype)
        stepped, acceleration, wall = self._stepper.step(before, inner, self.record.steps, self.surroundings)
        self.surroundings.at(self.time + (done + step) * self.units.time)
        after = self.surroundings.constrain(before, stepped, wall, inner, self.record)
        waiting = step == 0
        if bool(waiting.any()):
            after, acceleration = held(waiting, before, after), held_rows(waiting, before, push, acceleration)
        self.particles, self._acceleration, done = after, acceleration, done + step
        broken = self._broken() & ~self.record.failed
        if self._work is not None:
            counts, by_valves = (step > 0) & ~broken, self.surroundings.valve_acceleration
            self._work.note(before, stepped, wall, inner, self._stepper, counts, by_valves)
        if bool(broken.any()):
            done = self._recover(broken, before, push, done, checkpoints)
        return done

    def _broken(self) -> Tensor:
        """Members (members,) bool with a particle that is not finite, or denser or thinner than a rollback allows.

        Notes the densities on the way; in an incompressible fluid they do not change.
        """
        p, scheme = self.particles, self.domain.scheme
        broken = torch.zeros_like(self.record.failed)
        # a sum is finite only if all its terms are; which they are is looked up only where it is not
        if not math.isfinite(float(p.position.sum() + p.velocity.sum() + p.deviation.sum())):
            finite = torch.isfinite(p.position).all(1) & torch.isfinite(p.velocity).all(1) & torch.isfinite(p.deviation)
            broken = p.per_member((~finite).to(torch.int64), "sum") > 0
        if scheme.compressible:
            lowest, highest = (p.per_member(p.deviation, way) for way in ("amin", "amax"))
            self.record.note_density(lowest, highest)
            if scheme.rollback is not None:
                least, most = scheme.rollback.density
                broken |= (1.0 + lowest < least) | (1.0 + highest > most)
        return broken

    def _recover(
        self, broken: Tensor, before: Particles, push: Tensor, done: Tensor, checkpoints: Checkpoints | None
    ) -> Tensor:
        """Put broken members back to their last good state, for another try or for good."""
        if checkpoints is not None:
            self.particles, self._acceleration, done, broken = checkpoints.restored(
                broken, self.particles, self._acceleration, done
            )
        else:
            self._acceleration = held_rows(broken, before, push, self._acceleration)
            self.particles = held(broken, before, self.particles)
        self._fail(broken)
        return done

    def _fail(self, broken: Tensor) -> None:
        """Freeze members for good."""
        self.record.failed |= broken
        if bool(self.record.failed.all()):
            raise NumericalFailure(
                f"all {self.members} members have failed (not finite, too fast for any step, or beyond the density "
                "that a rollback allows) "
                f"after {self.record.steps.tolist()} steps at about {self.time:.6g} s; lower the Courant fraction, "
                "raise the sound speed, or check the imposed velocity (largest Mach number "
                f"{float(self.record.largest_mach.max()):.2f})"
            )

    def _fail_lost(self) -> None:
        """Freeze members that come with positions that are not finite, so that the others can be searched."""
        p = self.particles
        lost = ~torch.isfinite(p.position).all(1)
        if bool(lost.any()):
            self._fail(p.per_member(lost.to(torch.int64), "sum") > 0)
            self.particles = p.changed(position=torch.where(lost[:, None], torch.zeros_like(p.position), p.position))

    def _forget_pairs(self) -> None:
        self._stepper.pair_search.forget()
        if self._acceleration.shape != self.particles.position.shape:
            self._acceleration = torch.zeros_like(self.particles.position)

    def impose(self, grid: Grid, velocity: Tensor, mask: Tensor, confidence: Tensor | None = None) -> None:
        """Replace the particles' velocities by those of a grid at the present time.

        Args:
            grid: the nodes, m. velocity: (D, *shape) for all members or (members, D, *shape), m/s.
            mask: (*shape) bool, where the velocity is known. Beyond it the walls' velocity continues the field.
            confidence: (*shape), not negative, how far each node is to be trusted; the particles carry it along, and it
                weighs them in XSPH and in fetching (thesis 5.2). None: all alike.

        Raises:
            ValueError: a confidence is negative or not finite.
        """
        if confidence is not None and not bool((torch.isfinite(confidence) & (confidence >= 0)).all()):
            raise ValueError("confidences must be finite and not negative")
        self.particles = self.surroundings.imposed(self.particles, grid, velocity, mask, self.time)
        carried = None
        if confidence is not None:
            field = confidence.to(self.particles.velocity)[None]
            carried = grid.sample(field, self.particles.position * self.units.length)[0].clamp_min(0.0)
        self.particles = replace(self.particles, confidence=carried)
        self._imposed_at = self.time
        self._forget_pairs()

    @property
    def can_project(self) -> bool:
        """Whether ``project`` knows what the scene's walls ask for."""
        return self.domain.walls is None or self.domain.scheme.wall.complete

    def project(self, times: int = 1) -> Tensor:
        """Make the fluid's velocities free of divergence, as the walls and the flux of open valves ask for.

        Costs ``times`` pressure solves; meant for velocities that were imposed, in scenes whose fluid fills its walls
        or its periodic box. Returns (members,) what was taken from the velocities, RMS relative to the RMS of what is
        left: the blow that the fluid would have got from its pressure in the first step.
        """
        if not self.can_project:
            raise ValueError("projecting velocities needs complete-kernel walls; potential walls have no kernel share")
        self.surroundings.enter(self.time, self.time)
        wall = self.surroundings.sample(self.particles)
        search = self._stepper.pair_search
        here = Neighbourhood(self.particles, search, search.at(self.particles), self._stepper.support, wall)
        before = self.particles
        self.particles = before.changed(velocity=divergence_free(here, times=times))
        mass = torch.where(before.fluid, before.mass, torch.zeros_like(before.mass)).double()
        taken, left = (
            before.per_member(mass * velocity.double().square().sum(1), "sum")
            for velocity in (before.velocity - self.particles.velocity, self.particles.velocity)
        )
        return (taken / left.clamp_min(torch.finfo(left.dtype).tiny)).sqrt()

    def pull(self, grid: Grid, target: Tensor, gain: Tensor, weight: Tensor) -> None:
        """Pull the particles' velocities towards a measured grid.

        Args:
            target: (D, *shape), m/s. gain: (*shape) in [0, 1]. weight: (*shape) confidence, 0 where nothing is known.
        """
        p = self.particles
        points = p.position * self.units.length
        moved = pulled(points, p.velocity * self.units.speed, grid, target, gain, weight) / self.units.speed
        self.particles = p.changed(velocity=torch.where(p.inside[:, None], moved, p.velocity))

    def fetch(self, grid: Grid, mask: Tensor) -> Fetched:
        """Velocities at the nodes where ``mask`` (*shape): value (members, D, *shape), covered (members, *shape)."""
        p = self.particles
        node = torch.nonzero(mask.reshape(-1)).squeeze(1)
        points = grid.nodes(dtype=torch.float64, device=p.position.device)[node] / self.units.length
        points = points.to(p.position.dtype).repeat(self.members, 1)
        owner = torch.arange(self.members, device=p.member.device).repeat_interleave(len(node))
        found = fetch_at(
            self._backend,
            points,
            owner,
            p.position,
            p.member,
            p.velocity * self.units.speed,
            FETCH_RADIUS,
            period=self.domain.period,
            weight=p.confidence,
        )
        dimension = grid.dimension
        value = p.velocity.new_zeros((self.members, dimension, grid.size))
        covered = torch.zeros((self.members, grid.size), dtype=torch.bool, device=p.member.device)
        value[:, :, node] = found.value.reshape(self.members, len(node), dimension).transpose(1, 2)
        covered[:, node] = found.covered.reshape(self.members, len(node))
        shape = grid.shape
        return Fetched(value.reshape(self.members, dimension, *shape), covered.reshape(self.members, *shape))
