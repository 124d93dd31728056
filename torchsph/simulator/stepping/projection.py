"""Time steps of the incompressible scheme."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import torch
from torch import Tensor

from torchsph.pairs.interface import MomentumTerms, Rates, RateTerms, Support
from torchsph.pairs.poisson import PoissonSolution
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.pairs.vectors import inner, per_particle

from ..schemes.projection import Projection
from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..state.record import Record
from ..transfer.exchange import grown
from ..walls.interface import FluidAtWalls, WallSample
from ..walls.registry import wall_forces
from .coefficients import Coefficients
from .pressure import Neighbourhood
from .protocols import Stepped, Surroundings
from .shifting import Shifting
from .terms import softened_share


class ProjectionStepper:
    """Steps particles with the incompressible scheme.

    Args:
        scheme: options.
        coefficients: of the run, internal units.
        search: neighbour list.
        dimension: 2 or 3.
        record: account of the run, to which the projections are noted.
    """

    def __init__(
        self, scheme: Projection, coefficients: Coefficients, search: PairSearch, dimension: int, record: Record
    ) -> None:
        self.scheme, self.pair_search, self.dimension, self._record = scheme, search, dimension, record
        self.prescribed_kinds: Tensor | None = None  # kinds of the buffers whose pressure is given
        self._walls = wall_forces(scheme.wall)
        self.use(coefficients)

    def use(self, coefficients: Coefficients) -> None:
        """Step with these coefficients from now on."""
        self.coefficients = coefficients
        self.support = Support(kernel(self.scheme.kernel), coefficients.smoothing_length, self.dimension)
        self._shifting = Shifting.of(self.scheme, coefficients)
        self._laminar = None
        if coefficients.viscosity is not None:
            acting = coefficients.viscosity / softened_share(self.support.kernel, self.dimension)
            self._laminar = MomentumTerms(pressure=None, laminar=acting)
        self._terms = RateTerms(
            concentration=coefficients.shifting is not None,
            shepard=self.scheme.relaxation is not None or self.scheme.surface is not None,
        )

    def apart(self, coefficients: Coefficients, record: Record) -> ProjectionStepper:
        """See ``Stepper.apart``."""
        other = copy(self)
        other.pair_search, other._record = self.pair_search.apart(), record
        other.use(coefficients)
        return other

    def at_pressure(self, particles: Particles, row: Tensor, pressure: Tensor) -> Particles:
        """Particles whose ``row`` (n,) carry ``pressure`` (n,), p / rho0, into the next projection."""
        return particles.changed(pressure=self.pressure(particles).index_copy(0, row, pressure))

    def pressure(self, particles: Particles) -> Tensor:
        """p / rho0 (N,) of the last projection; 0 before the first."""
        return torch.zeros_like(particles.mass) if particles.pressure is None else particles.pressure

    def step(self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings) -> Stepped:
        """Advance every member by a step of its own (``Stepper.step``).

        Half the way with the old velocity, there friction and body forces and the projection, then the other half with
        the new velocity: positions are so of second order.
        """
        dt = per_particle(step, particles.member)
        half = 0.5 * dt[:, None]
        middle = self._half_way(particles, half, step, around)
        wall, before = around.sample(middle), middle.velocity
        surroundings = Neighbourhood(middle, self.pair_search, self.pair_search.at(middle), self.support, wall)
        balanced, force = self._split(around.body_force(middle))
        sums, force = self._sums(surroundings, force)
        if force is not None:
            kicked = torch.where(middle.fluid[:, None], middle.velocity + dt[:, None] * force, middle.velocity)
            middle = middle.changed(velocity=kicked)
        # the divergence of friction itself, small in a fluid of little viscosity, is met in the next step
        divergence, gradient = replace(surroundings, particles=middle).divergence(sums)
        guess = self._guess(middle, balanced, dt)
        acting, found = self._project(surroundings, middle, sums, divergence, guess, around)
        self._account(found, step)
        velocity = middle.velocity + acting
        # what has not converged is no start for the next solve
        rate = torch.where(dt > 0, 1.0 / dt.clamp_min(torch.finfo(dt.dtype).tiny), torch.zeros_like(dt))
        pressure = found.values * rate * found.converged.index_select(0, particles.member)
        pressure = pressure if balanced is None else pressure + (balanced * middle.position).sum(1)
        drift = half * velocity
        if self._shifting is not None and gradient is not None:
            drift = drift + self._shift(self._shifting, middle.changed(velocity=velocity), gradient, step)
        acceleration = (velocity - before) * rate[:, None]
        after = middle.changed(position=middle.position + drift, velocity=velocity, pressure=pressure)
        if after.exchange is not None:
            after = grown(after, dt)
        return Stepped(after, acceleration, None if wall is None else _earlier(wall, half, before))

    @staticmethod
    def _half_way(particles: Particles, half: Tensor, step: Tensor, around: Surroundings) -> Particles:
        """Particles after ``half`` (N, 1), time, of their way, and what reservoirs prescribe then."""
        # a member that is not finite must not keep the others from their search; its velocity still gives it away
        drift = torch.nan_to_num(half * particles.velocity, nan=0.0, posinf=0.0, neginf=0.0)
        return around.later(particles.changed(position=particles.position + drift), 0.5 * step)

    def _project(
        self,
        surroundings: Neighbourhood,
        kicked: Particles,
        sums: Rates,
        divergence: Tensor,
        guess: Tensor | None,
        around: Surroundings,
    ) -> tuple[Tensor, PoissonSolution]:
        """What the pressure adds to the velocity in the step (N, D), and the solution for pressure times step.

        Args:
            surroundings: half-way, before the kick.
            kicked: the particles after friction and body forces.
            sums: of the first pass.
            divergence: (N,), of the kicked velocity, complete at walls.
            guess: (N,), of the solution, or None.
            around: which knows what the volume lacks.
        """
        source, surface = self._source(surroundings, sums, divergence)
        prescribed = None
        if self.prescribed_kinds is not None:
            prescribed = torch.isin(kicked.kind, self.prescribed_kinds)
            source = source - self._deficit_source(kicked, prescribed, around)
            guess = torch.zeros_like(source) if guess is None else guess
        scheme = self.scheme
        return surroundings.project(source, guess, surface, scheme.tolerance, scheme.iterations, prescribed)

    def _source(self, surroundings: Neighbourhood, sums: Rates, divergence: Tensor) -> tuple[Tensor, Tensor | None]:
        """Source of the pressure (N,), and which particles lie at a free surface (N,) bool, or None."""
        surface, source, exchange = None, -divergence, surroundings.particles.exchange
        if exchange is not None:
            source = source + torch.where(surroundings.particles.inside, exchange, torch.zeros_like(exchange))
        if not self._terms.shepard:
            return source, surface
        filling = surroundings.filling(sums)
        if self.scheme.surface is not None:
            surface = filling < self.scheme.surface
        if self.scheme.relaxation is not None:
            inside = surroundings.particles.inside
            counted = inside if surface is None else inside & ~surface
            source = source + surroundings.excess(filling, counted) / self.scheme.relaxation
        return source, surface

    @staticmethod
    def _deficit_source(particles: Particles, prescribed: Tensor, around: Surroundings) -> Tensor:
        """What the fluid's volume should grow by, per time (N,), in members with buffers of ``prescribed`` (N,) bool.

        Through other openings the flux sees to it; here the flow has to draw in what is missing.
        """
        drawn = particles.per_member(prescribed.to(torch.int64), "sum") > 0
        drawn = particles.inside & drawn.index_select(0, particles.member)
        return torch.where(drawn, around.volume_deficit_rate(particles), torch.zeros_like(particles.mass))

    def _split(self, force: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """A body force (N, D) as the part that only adds its potential to the pressure, and the rest; None for nothing.

        Without a free surface or a given pressure a uniform force moves nothing along an axis that is not periodic. The
        pressure that bears it would be large, and its differences on disordered particles stir the fluid; so it is left
        out of the equation and added afterwards, exactly.
        """
        if force is None or self.scheme.surface is not None or self.prescribed_kinds is not None:
            return None, force
        if self.pair_search.period is None:
            return force, None
        balanced = torch.where(torch.isinf(self.pair_search.period), force, torch.zeros_like(force))
        return balanced, force - balanced

    def _sums(self, surroundings: Neighbourhood, force: Tensor | None) -> tuple[Rates, Tensor | None]:
        """First-pass sums, and the acceleration (N, D) by friction and ``force``, or None without either."""
        particles, wall = surroundings.particles, surroundings.wall
        if self._laminar is None:
            return surroundings.rates(self._terms), force
        backend, state = self.pair_search.backend, particles.state(particles.deviation)
        sums, drag = backend.right_hand_side(surroundings.pairs, state, self.support, self._terms, self._laminar)
        if wall is not None:
            fluid = FluidAtWalls(
                particles.velocity, particles.deviation, particles.member, viscosity=self.coefficients.viscosity
            )
            drag = self._walls.accelerate(drag, fluid, wall)
        return sums, drag if force is None else force + drag

    @staticmethod
    def _guess(particles: Particles, balanced: Tensor | None, dt: Tensor) -> Tensor | None:
        """The last step's pressure times this step; None before the first (half the iterations of a start from 0)."""
        if particles.pressure is None:
            return None
        pressure = particles.pressure
        return dt * (pressure if balanced is None else pressure - (balanced * particles.position).sum(1))

    @staticmethod
    def _shift(shifting: Shifting, particles: Particles, gradient: Tensor, step: Tensor) -> Tensor:
        """Displacements (N, D) by shifting; none of the buffers."""
        shift = shifting.displacement(particles, gradient, step)
        return torch.where(particles.fluid[:, None], shift, torch.zeros_like(shift))

    def _account(self, found: PoissonSolution, step: Tensor) -> None:
        """Note iterations, failures and sources that no pressure answers, of the members that step."""
        record, steps = self._record, step > 0
        record.pressure_iterations += torch.where(steps, found.iterations, torch.zeros_like(found.iterations))
        record.unconverged += steps & ~found.converged
        mismatch = torch.where(steps, found.mismatch.abs(), torch.zeros_like(found.mismatch))
        record.largest_mismatch = torch.maximum(record.largest_mismatch, mismatch)


def _earlier(wall: WallSample, half: Tensor, velocity: Tensor) -> WallSample:
    """Walls seen half a step later, with the distance that there was before, to first order: ``half`` (N, 1), time."""
    approach = half[:, 0] * inner(velocity - wall.velocity, wall.normal)
    return replace(wall, distance=wall.distance - approach)
