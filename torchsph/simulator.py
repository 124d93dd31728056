"""The simulator: a scene and a scheme make running batches of members that advance together."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from geometry import Grid

from .domain import Domain
from .integrate import Coefficients, PairSearch, Stepper
from .pairs import backend as choose_backend
from .particles import Particles
from .record import Record
from .scene import Scene
from .schemes import WeaklyCompressible, preset
from .seeding import Seeding, seed_particles
from .terms import LIMITS, step_limits
from .transfer import Fetched, fetch_at, pulled
from .units import Units

# how far particles move before the neighbours are searched again, in spacings
_SEARCH_MARGIN = 0.25
# support radius of the fetching weight, in spacings
FETCH_RADIUS = 2.0


class NumericalFailure(RuntimeError):
    """Every member of a run has failed; the record says how far each came."""


@dataclass(frozen=True)
class Simulator:
    """A scene with the way to step it.

    Args:
        scene: fluid, walls, valves, forces (SI).
        scheme: ``WeaklyCompressible`` options; None takes the default preset.
        device, dtype: where and in what precision particles live (float32 or float64).
        backend: name of the pair backend, or "auto" for the best one present.
        seeding: how particles are placed; None takes what the scheme's walls call for.
    """

    scene: Scene
    scheme: WeaklyCompressible | None = None
    device: str = "cpu"
    dtype: torch.dtype = torch.float32
    backend: str = "auto"
    seeding: Seeding | None = None

    def __post_init__(self) -> None:
        if self.scheme is None:
            object.__setattr__(self, "scheme", preset("default"))
        if self.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"Simulator.dtype must be torch.float32 or torch.float64, got {self.dtype}")
        choose_backend(self.backend, self.device)  # a missing backend must not surface in the middle of a run
        units = Units(self.scene.spacing, self.scene.reference_speed)
        domain = Domain(self.scene, self.scheme, units, self.device, self.dtype)
        object.__setattr__(self, "_domain", domain)

    @property
    def domain(self) -> Domain:
        """Walls, valves and forces as particles see them; shared by all runs."""
        return self._domain

    def start(self, time: float, *, members: int = 1, seed: int = 0) -> Simulation:
        """A resting fluid at ``time`` (s): ``members`` copies of one seeding, drawn with ``seed``."""
        if members < 1:
            raise ValueError(f"a simulation needs at least one member, got {members}")
        generator = torch.Generator(device=self.device).manual_seed(seed)
        one = seed_particles(self, time, generator)
        return self.resume(one.repeated(members), time)

    def resume(self, particles: Particles, time: float) -> Simulation:
        """Run on with particles in internal units that were made elsewhere."""
        return Simulation(self, particles, time)


class Simulation:
    """A batch of members on their way through time.  Particles and record change; the simulator does not.

    Attributes:
        particles: the flat set of all members, internal units.
        record: accounts of the run.
        time: present time, s.
    """

    def __init__(self, simulator: Simulator, particles: Particles, time: float) -> None:
        self.simulator, self.particles, self.time = simulator, particles, float(time)
        self.domain, self.units = simulator.domain, simulator.domain.units
        scene, scheme = simulator.scene, simulator.scheme
        self.record = Record(particles.members, len(scene.valves), particles.position.device)
        viscosity = scene.fluid.kinematic_viscosity / self.units.kinematic_viscosity
        sound = scheme.sound_speed / self.units.speed
        self._coefficients = Coefficients(
            sound_speed=sound, viscosity=viscosity if scheme.laminar_viscosity and viscosity > 0 else None,
            artificial=None if not scheme.artificial_viscosity else scheme.artificial_viscosity * sound,
            smoothing_length=scheme.smoothing_ratio,
        )
        self._backend = choose_backend(simulator.backend, simulator.device)
        search = PairSearch(
            self._backend, self.domain.support_radius, _SEARCH_MARGIN,
            self.domain.period,
        )
        self._stepper = Stepper(scheme, self._coefficients, search, scene.dimension)
        self._acceleration = torch.zeros_like(particles.position)
        self._steps = 0
        self._last_limit = torch.zeros(particles.members, dtype=torch.float64, device=particles.position.device)

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
        longest = (until - self.time) / (self.simulator.scheme.steps_per_frame or 1) / self.units.time
        for stop in self.domain.breaks(self.time, until):
            self.domain.enter(self.time, stop)
            self.particles = self.domain.prepare(self.particles)
            self._forget_pairs()
            self._advance_interval(stop, longest)
            self.time = stop
            self.particles = self.domain.finish(self.particles, self.record, stop)
            self._forget_pairs()
        self.record.searches = self._stepper.pair_search.searches
        self.domain.account(self.particles, self.record, self.time)

    def _advance_interval(self, stop: float, longest: float) -> None:
        duration = (stop - self.time) / self.units.time
        done = torch.zeros(self.members, dtype=torch.float64, device=self.particles.position.device)
        while True:
            left = torch.where(self.record.failed, torch.zeros_like(done), duration - done)
            if not bool((left > 1e-9 * duration).any()):
                return
            step = self._time_step(left, longest)
            self.domain.at(self.time + done * self.units.time)
            if self._stepper.pair_search.stale(self.particles):
                before = self.particles.count
                self.particles, renumbered = self.domain.exchange(self.particles, self.record)
                if renumbered:
                    self._forget_pairs()
                if self.particles.count != before:
                    self._acceleration = torch.zeros_like(self.particles.position)
            self._take_step(step.to(self.particles.position.dtype))
            done = done + step

    def _time_step(self, left: Tensor, longest: float) -> Tensor:
        """Each member's step (members,) float64: the smallest limit, evened out over what is left of the interval."""
        p = self.particles
        speed = p.per_member(p.velocity.norm(dim=1), "amax")
        force = p.per_member(self._acceleration.norm(dim=1), "amax")
        c = self._coefficients
        limits = step_limits(
            speed, force, c.smoothing_length, c.sound_speed, c.viscosity or 0.0, self.simulator.scheme.courant
        ).double()
        frame = torch.full_like(limits[:1], longest)
        active = left > 0
        smallest, which = torch.cat([self._floored(limits, active), frame]).min(0)
        self.record.reductions += active & (smallest < 0.99 * self._last_limit)
        self._last_limit = torch.where(active, smallest, self._last_limit)
        steps = torch.ceil(left / smallest - 1e-9).clamp_min(1.0)
        even = torch.where(left > 0, left / steps, torch.zeros_like(left))
        which = torch.where(steps > 1, which, len(LIMITS) - 1)
        self.record.limited_by.scatter_add_(1, which[:, None], active[:, None].to(torch.int64))
        self.record.steps += active
        mach = speed / c.sound_speed
        self.record.largest_mach = torch.maximum(self.record.largest_mach, mach.double())
        return even

    def _floored(self, limits: Tensor, active: Tensor) -> Tensor:
        """The limits (3, members), none below the scheme's floor; the record counts where that changed the step."""
        scheme, c = self.simulator.scheme, self._coefficients
        if scheme.step_floor is None:
            return limits
        floor = scheme.step_floor * scheme.courant * c.smoothing_length / c.sound_speed
        # the viscous limit is known beforehand and no accident: it stays
        held = (limits[[0, 2]] < floor).any(0) & (limits[1] > floor)
        self.record.floored += active & held
        return torch.stack([limits[0].clamp_min(floor), limits[1], limits[2].clamp_min(floor)])

    def _take_step(self, step: Tensor) -> None:
        before = self.particles
        after, acceleration, wall = self._stepper.step(before, step, self._steps, self.domain)
        after = self.domain.constrain(before, after, wall, step, self.record)
        self._steps += 1
        finite = torch.isfinite(after.position).all(1) & torch.isfinite(after.velocity).all(1)
        finite &= torch.isfinite(after.deviation)
        if not bool(finite.all()):
            after = self._freeze(before, after, finite)
            acceleration = torch.nan_to_num(acceleration)
        self.particles, self._acceleration = after, acceleration
        lowest = after.per_member(after.deviation, "amin")
        self.record.note_density(lowest, after.per_member(after.deviation, "amax"))

    def _freeze(self, before: Particles, after: Particles, finite: Tensor) -> Particles:
        """Put members with a non-finite particle back to their last good state, for good."""
        broken = before.per_member((~finite).to(torch.int64), "sum") > 0
        self.record.failed |= broken
        if bool(self.record.failed.all()):
            raise NumericalFailure(
                f"all {self.members} members became non-finite after {self.record.steps.tolist()} steps at about "
                f"{self.time:.6g} s; lower the Courant fraction, raise the sound speed, or check the imposed velocity "
                f"(largest Mach number {float(self.record.largest_mach.max()):.2f})"
            )
        back = broken[before.member]
        keep = {
            name: torch.where(back.reshape(-1, *[1] * (getattr(after, name).ndim - 1)), getattr(before, name),
                              getattr(after, name))
            for name in ("position", "velocity", "deviation")
        }
        return after.changed(**keep)

    def _forget_pairs(self) -> None:
        self._stepper.pair_search.forget()
        if self._acceleration.shape != self.particles.position.shape:
            self._acceleration = torch.zeros_like(self.particles.position)

    def impose(self, grid: Grid, velocity: Tensor, mask: Tensor) -> None:
        """Replace the particles' velocities by those of a grid at the present time.

        Args:
            grid: the nodes, m. velocity: (D, *shape) for all members or (members, D, *shape), m/s.
            mask: (*shape) bool, where the velocity is known. Beyond it the walls' velocity continues the field.
        """
        self.particles = self.domain.imposed(self.particles, grid, velocity, mask, self.time)
        self._forget_pairs()

    def pull(self, grid: Grid, target: Tensor, gain: Tensor, weight: Tensor) -> None:
        """Pull the particles' velocities towards a measured grid.

        Args:
            target: (D, *shape), m/s. gain: (*shape) in [0, 1]. weight: (*shape) confidence, 0 where nothing is known.
        """
        p = self.particles
        points = p.position * self.units.length
        moved = pulled(points, p.velocity * self.units.speed, grid, target, gain, weight) / self.units.speed
        self.particles = p.changed(velocity=torch.where(p.fluid[:, None], moved, p.velocity))

    def fetch(self, grid: Grid, mask: Tensor) -> Fetched:
        """Velocities at the nodes where ``mask`` (*shape): value (members, D, *shape), covered (members, *shape)."""
        return self._fetched(grid, mask, self.particles.velocity * self.units.speed)

    def _fetched(self, grid: Grid, mask: Tensor, carried: Tensor) -> Fetched:
        p = self.particles
        node = torch.nonzero(mask.reshape(-1)).squeeze(1)
        points = grid.nodes(dtype=torch.float64, device=p.position.device)[node] / self.units.length
        points = points.to(p.position.dtype).repeat(self.members, 1)
        owner = torch.arange(self.members, device=p.member.device).repeat_interleave(len(node))
        found = fetch_at(
            self._backend, points, owner, p.position, p.member, carried, FETCH_RADIUS, period=self.domain.period
        )
        dimension = grid.dimension
        value = p.velocity.new_zeros((self.members, dimension, grid.size))
        covered = torch.zeros((self.members, grid.size), dtype=torch.bool, device=p.member.device)
        value[:, :, node] = found.value.reshape(self.members, len(node), dimension).transpose(1, 2)
        covered[:, node] = found.covered.reshape(self.members, len(node))
        shape = grid.shape
        return Fetched(value.reshape(self.members, dimension, *shape), covered.reshape(self.members, *shape))
