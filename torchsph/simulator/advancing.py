"""A batch of members on their way through time: what is done between steps, and what after each."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchsph.pairs.interface import Backend

from .domain import Domain
from .failures import broken_members, check_volume, freeze_members, without_lost
from .population import Population
from .rollback import RollbackStates
from .spatial_sort import SpatialSort
from .state.checks import check_arrays, check_members, check_time
from .state.neighbour_list import PairSearch, rows_carried
from .state.particles import Particles, frozen, rows_frozen
from .state.record import Record
from .stepping.coefficients import Coefficients, Parameters
from .stepping.replayed_step import Step
from .stepping.step_length import StepControl
from .stepping.stepper import make_stepper
from .surroundings import PresentSurroundings
from .work import WorkAccount

# how far particles move before the neighbours are searched again, in spacings
_SEARCH_MARGIN = 0.25
# a member that would need more steps than this for the rest of an interval has broken down
_MOST_STEPS = 1e7


# why a scheme without a free surface refuses particles
_UNFILLED = (
    "the particles fill {filling} of what encloses them, so the fluid has a free surface: give "
    "Projection(surface=0.85), or step with the weakly compressible scheme"
)


class AdvancingRun:
    """A batch of members that advance together.  Particles and record change; the domain does not.

    Attributes:
        domain: walls, valves and forces.
        surroundings: what particles see of them at their present times.
        units: internal units.
        particles: the flat set of all members, internal units.
        parameters: the numbers of the scheme in use.
        record: accounts of the run.
        time: present time, s.
        observers: each is called after every step with the present times of the members (members,), s, and the lengths
            of their steps (members,), s, 0 where one waits or has failed; none: nobody looks on, which costs nothing.
    """

    def __init__(self, domain: Domain, backend: Backend, particles: Particles, time: float) -> None:
        self.domain, self.units, self.particles, self.time = domain, domain.units, particles, float(time)
        self.surroundings, self._backend = PresentSurroundings(domain), backend
        self.observers: list[Callable[[Tensor, Tensor], None]] = []
        scene, scheme = domain.scene, domain.scheme
        self.record = Record(particles.members, len(scene.valves), particles.position.device)
        self.parameters = Parameters.of(scheme, scene.fluid.viscosity)
        self._coefficients = Coefficients.of(self.parameters, self.units, scene.fluid.density)
        # incompressible steps see their neighbours once; lists of that moment also make them independent of a batch
        margin = _SEARCH_MARGIN if scheme.compressible else 0.0
        search = PairSearch(self._backend, self.domain.support_radius, margin, self.domain.period)
        if scheme.must_fill and particles.count:
            domain.check_filled(particles, self.time, _UNFILLED)
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
        holds = scene.valves and domain.walls is not None and scheme.valve is not None
        self._filled = domain.filling(particles, self.time) if holds else None
        self._spatial = SpatialSort(search)

    @property
    def members(self) -> int:
        """Number of members, failed ones included."""
        return self.particles.members

    @property
    def backend(self) -> Backend:
        """For sums over neighbours."""
        return self._backend

    @property
    def period(self) -> Tensor | None:
        """(D,), internal, of the periodic box, or None."""
        return self.domain.period

    def pressure(self) -> Tensor:
        """(N,), Pa, of the particles: up to a constant where nothing prescribes one."""
        return self._stepper.pressure(self.particles) * (self.domain.scene.fluid.density * self.units.speed**2)

    def advance(self, until: float) -> None:
        """Step every member that has not failed to time ``until`` (s), each with its own time step.

        Raises:
            NumericalFailure: no member is left; a member that fails before is frozen and flagged.
            ValueError: ``until`` is not finite, lies in the past or where the wall's motion is not known; or somebody
                has put in particles whose arrays disagree.
        """
        until = check_time(until, "the time to advance to")
        check_arrays(self.particles, self.domain.scene.dimension, self.domain.dtype, self.domain.device)
        check_members(self.particles)
        if until < self.time:
            raise ValueError(f"cannot advance backwards, from {self.time} s to {until} s")
        self.domain.check_known(until)
        if until == self.time:
            return
        self.particles = without_lost(self.particles, self.record, self.time)
        self.particles, self._acceleration = self._spatial.begin(self.particles, self._acceleration)
        longest = self._longest_step(until)
        for stop in self.domain.breaks(self.time, until):
            self.surroundings.enter(self.time, stop)
            self._renumbered(self.surroundings.prepare(self.particles))
            self._advance_interval(stop, longest)
            self.time = stop
            self._renumbered(self.surroundings.finish(self.particles, self.record, stop, self._stepper.pressure))
        self.particles, self._acceleration = self._spatial.end(self.particles, self._acceleration)
        self.record.searches = self._stepper.pair_search.searches
        self.record.overflows = self._backend.overflows
        self.surroundings.account(self.particles, self.record, self.time, self._began_at)
        if self._filled is not None:
            check_volume(self.record, self._filled, self.time)

    def _longest_step(self, until: float) -> float:
        """Limit of the steps to time ``until`` (s) that the scheme names outright, internal."""
        scheme = self.domain.scheme
        longest = (until - self.time) / (scheme.steps_per_frame or 1)
        if scheme.max_step is not None:
            longest = min(longest, scheme.max_step)
        longest /= self.units.time
        return longest if scheme.longest_step is None else min(longest, scheme.longest_step)

    def _advance_interval(self, stop: float, longest: float) -> None:
        duration = (stop - self.time) / self.units.time
        done = torch.zeros(self.members, dtype=torch.float64, device=self.particles.position.device)
        options = self.domain.scheme.rollback
        earlier = None if options is None else RollbackStates(options, self.record)
        while True:
            left = torch.where(self.record.failed, torch.zeros_like(done), duration - done)
            left = torch.where(left > 1e-9 * duration, left, torch.zeros_like(left))
            if not bool((left > 0).any()):
                return
            if earlier is not None:
                earlier.keep(self.particles, self._acceleration, done)
            self._ramp(done)
            step = self._control.step(
                self.particles,
                self._acceleration,
                self._stepper.coefficients,
                left,
                longest,
                None if earlier is None else earlier.factor,
            )
            hopeless = (left > 0) & (step * _MOST_STEPS < left)
            any_hopeless, any_waiting = torch.stack([hopeless.any(), (step == 0).any()]).tolist()
            if any_hopeless:
                freeze_members(hopeless, self.record, self.time)
                continue
            self.surroundings.at(self.time + done * self.units.time)
            self._prepare_step(step > 0)
            done = self._take_step(step, done, earlier, any_waiting)
            if self.observers:
                length = torch.where(self.record.failed, torch.zeros_like(step), step) * self.units.time
                for observer in self.observers:
                    observer(self.time + done * self.units.time, length)

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

    def _prepare_step(self, active: Tensor) -> None:
        """What changes the set of particles between steps; in the members ``active`` (members,) bool that step.

        Particles that have crossed an open valve change sides in every step: the flow must not feel the search.
        """
        particles, renumbered = self.surroundings.exchange(self.particles, self.record, self._stepper.pressure, active)
        if self._population is not None:
            particles, changed = self._population.controlled_when_due(particles, active)
            renumbered |= changed
        if renumbered:
            self._acceleration = rows_carried(self.particles, particles, self._acceleration)
        self.particles = particles
        if self._pressures is not None:
            self.particles = self._pressures.driven(self.particles, self.surroundings.clock, self._stepper, active)
        self.particles, self._acceleration = self._spatial.when_due(self.particles, self._acceleration)

    def _take_step(self, step: Tensor, done: Tensor, earlier: RollbackStates | None, any_waiting: bool) -> Tensor:
        """Step every member by its own ``step`` (members,), 0 for some if ``any_waiting``.

        Returns how far each has come in the interval, (members,).
        """
        before, old = self.particles, self._acceleration
        inner, ends = step.to(before.position.dtype), self.time + (done + step) * self.units.time
        plan = Step(self._stepper, self.surroundings, self.record, inner, ends, self.record.steps)
        after, acceleration, stepped, wall = plan.take(before)
        if any_waiting:
            waiting = step == 0
            after, acceleration = frozen(waiting, before, after), rows_frozen(waiting, before, old, acceleration)
        self.particles, self._acceleration, done = after, acceleration, done + step
        broken = broken_members(after, self.domain.scheme, self.record) & ~self.record.failed
        if self._work is not None:
            counts, by_valves = (step > 0) & ~broken, self.surroundings.valve_acceleration
            self._work.note(before, stepped, wall, inner, self._stepper, counts, by_valves)
        if bool(broken.any()):
            done = self._recover(broken, before, old, done, earlier)
        return done

    def _recover(
        self, broken: Tensor, before: Particles, acceleration: Tensor, done: Tensor, earlier: RollbackStates | None
    ) -> Tensor:
        """Put broken members back to their last good state, for another try or for good.

        Args:
            broken: (members,) bool.
            before: the particles before the step that broke them.
            acceleration: (N, D), theirs.
            done: (members,), how far each has come in the interval.
            earlier: states to go back to, or None.

        Returns:
            ``done`` afterwards.
        """
        if earlier is not None:
            self.particles, self._acceleration, done, broken = earlier.restored(
                broken, self.particles, self._acceleration, done
            )
        else:
            self._acceleration = rows_frozen(broken, before, acceleration, self._acceleration)
            self.particles = frozen(broken, before, self.particles)
        freeze_members(broken, self.record, self.time)
        return done

    def _renumbered(self, particles: Particles) -> None:
        """Go on with these particles, of which any may be new or gone."""
        self._acceleration = rows_carried(self.particles, particles, self._acceleration)
        self.particles = particles
        self._stepper.pair_search.forget()
