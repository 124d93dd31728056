"""Time steps of the incompressible scheme."""

from __future__ import annotations

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
from ..walls.compiled import complete_forces
from ..walls.forces import WallSample
from .coefficients import Coefficients
from .pressure import Neighbourhood
from .terms import shifting_displacement, softened_share
from .weakly_compressible import Surroundings


class ProjectionStepper:
    """Steps particles with the incompressible scheme; holds the neighbour list, coefficients and the accounts."""

    def __init__(
        self, scheme: Projection, coefficients: Coefficients, search: PairSearch, dimension: int, record: Record
    ) -> None:
        self.scheme, self.pair_search, self.dimension, self._record = scheme, search, dimension, record
        self.held_kinds: Tensor | None = None  # kinds of the buffers whose pressure is given
        self.use(coefficients)

    def use(self, coefficients: Coefficients) -> None:
        """Step with these coefficients from now on."""
        self.coefficients = coefficients
        self.support = Support(kernel(self.scheme.kernel), coefficients.smoothing_length, self.dimension)
        self._laminar = None
        if coefficients.viscosity is not None:
            acting = coefficients.viscosity / softened_share(self.support.kernel, self.dimension)
            self._laminar = MomentumTerms(pressure=None, laminar=acting)
        self._terms = RateTerms(
            concentration=coefficients.shifting is not None,
            shepard=self.scheme.relaxation is not None or self.scheme.surface is not None,
        )

    @staticmethod
    def at_pressure(particles: Particles, row: Tensor, pressure: Tensor) -> Particles:
        """Particles whose ``row`` (n,) carry ``pressure`` (n,), p / rho0, into the next projection."""
        return particles.changed(pressure=ProjectionStepper.pressure(particles).index_copy(0, row, pressure))

    @staticmethod
    def pressure(particles: Particles) -> Tensor:
        """p / rho0 (N,) of the last projection; 0 before the first."""
        return torch.zeros_like(particles.mass) if particles.pressure is None else particles.pressure

    def step(
        self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
    ) -> tuple[Particles, Tensor, WallSample | None]:
        """Advance every member by its own ``step`` (members,), internal time.

        Half the way with the old velocity, there friction and body forces and the projection, then the other half with
        the new velocity: positions are so of second order. Returns the particles, their acceleration (N, D) and the
        walls that they saw, as they were at the start.
        """
        dt = per_particle(step, particles.member)
        half = 0.5 * dt[:, None]
        # a member that is not finite must not keep the others from their search; its velocity still gives it away
        way = torch.nan_to_num(half * particles.velocity, nan=0.0, posinf=0.0, neginf=0.0)
        middle = particles.changed(position=particles.position + way)
        middle = around.later(middle, 0.5 * step)
        wall, before = around.sample(middle), middle.velocity
        here = Neighbourhood(middle, self.pair_search, self.pair_search.at(middle), self.support, wall)
        weight, force = self._split(around.body_force(middle))
        sums, force = self._sums(here, force)
        if force is not None:
            pushed = torch.where(middle.fluid[:, None], middle.velocity + dt[:, None] * force, middle.velocity)
            middle = middle.changed(velocity=pushed)
        # the divergence of friction itself, small in a fluid of little viscosity, is met in the next step
        divergence, crowding = replace(here, particles=middle).divergence(sums)
        source, surface = self._source(here, sums, divergence)
        held = None
        if self.held_kinds is not None:
            held = torch.isin(middle.kind, self.held_kinds)
            source = source - self._drawn_in(middle, held, around)
        push, found = here.push(
            source, self._guess(middle, weight, dt), surface, self.scheme.tolerance, self.scheme.iterations, held
        )
        self._account(found, step)
        velocity = middle.velocity + push
        # what has not converged is no start for the next solve
        per_step = torch.where(dt > 0, 1.0 / dt.clamp_min(torch.finfo(dt.dtype).tiny), torch.zeros_like(dt))
        pressure = found.values * per_step * found.converged.index_select(0, particles.member)
        pressure = pressure if weight is None else pressure + (weight * middle.position).sum(1)
        drift = half * velocity
        if crowding is not None:
            drift = drift + self._shifted(middle.changed(velocity=velocity), crowding, step)
        acceleration = (velocity - before) * per_step[:, None]
        after = middle.changed(position=middle.position + drift, velocity=velocity, pressure=pressure)
        return after, acceleration, None if wall is None else _earlier(wall, half, before)

    def _source(self, here: Neighbourhood, sums: Rates, divergence: Tensor) -> tuple[Tensor, Tensor | None]:
        """Source of the pressure (N,), and which particles lie at a free surface (N,) bool, or None."""
        surface, source = None, -divergence
        filling = here.filling(sums) if self._terms.shepard else None
        if self.scheme.surface is not None:
            surface = filling < self.scheme.surface
        if self.scheme.relaxation is not None:
            inside = here.particles.inside
            counted = inside if surface is None else inside & ~surface
            source = source + here.excess(filling, counted) / self.scheme.relaxation
        return source, surface

    @staticmethod
    def _drawn_in(particles: Particles, held: Tensor, around: Surroundings) -> Tensor:
        """What the volume of the fluid inside should grow by, per time (N,), where a pressure is ``held`` (N,) bool.

        Through other openings the flux sees to it; here the flow has to draw in what is missing.
        """
        drawn = particles.per_member(held.to(torch.int64), "sum") > 0
        drawn = particles.inside & drawn.index_select(0, particles.member)
        return torch.where(drawn, around.shortfall(particles), torch.zeros_like(particles.mass))

    def _split(self, force: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """A body force (N, D) as the part that only adds its potential to the pressure, and the rest; None for nothing.

        Without a free surface or a given pressure a uniform force moves nothing along an axis that is not periodic. The
        pressure that bears it would be large, and its differences on disordered particles stir the fluid; so it is left
        out of the equation and added afterwards, exactly.
        """
        if force is None or self.scheme.surface is not None or self.held_kinds is not None:
            return None, force
        if self.pair_search.period is None:
            return force, None
        weight = torch.where(torch.isinf(self.pair_search.period), force, torch.zeros_like(force))
        return weight, force - weight

    def _sums(self, here: Neighbourhood, force: Tensor | None) -> tuple[Rates, Tensor | None]:
        """First-pass sums, and the acceleration (N, D) by friction and ``force``, or None without either."""
        particles, wall = here.particles, here.wall
        if self._laminar is None:
            return here.rates(self._terms), force
        state = particles.state(particles.deviation)
        sums, drag = here.search.backend.right_hand_side(here.pairs, state, self.support, self._terms, self._laminar)
        if wall is not None:
            nu = self.coefficients.viscosity if self.scheme.wall.no_slip else None
            drag = complete_forces(drag, particles.velocity, wall, viscosity=nu, member=particles.member)
        return sums, drag if force is None else force + drag

    @staticmethod
    def _guess(particles: Particles, weight: Tensor | None, dt: Tensor) -> Tensor | None:
        """The last step's pressure times this step; None before the first (half the iterations of a start from 0)."""
        if particles.pressure is None:
            return None
        pressure = particles.pressure
        return dt * (pressure if weight is None else pressure - (weight * particles.position).sum(1))

    def _shifted(self, particles: Particles, crowding: Tensor, step: Tensor) -> Tensor:
        shift = shifting_displacement(
            particles,
            crowding,
            step,
            self.coefficients.smoothing_length,
            self.coefficients.shifting,
            self.scheme.shifting_speed == "largest",
            self.scheme.shifting_surface,
        )
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
    way = half[:, 0] * inner(velocity - wall.velocity, wall.normal)
    return replace(wall, distance=wall.distance - way)
