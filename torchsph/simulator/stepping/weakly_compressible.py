"""One time step of the weakly compressible scheme: which sums are taken where, and what they change."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from torchsph.pairs.interface import MomentumTerms, Rates, RateTerms, Support
from torchsph.pairs.moving_least_squares import solve_small
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.pairs.vectors import per_particle

from ..schemes.wall_models import CompleteKernelWall, PotentialWall
from ..schemes.weakly_compressible import WeaklyCompressible
from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..walls.compiled import complete_forces, complete_rates
from ..walls.forces import WallSample, potential_force, retardation
from .coefficients import Coefficients
from .terms import (
    mls_deviation,
    shepard_deviation,
    shifting_displacement,
    softened_share,
    tait_deviation,
    tait_pressure,
)
from .time_schemes import predictor_corrector_step, verlet_step
from .xsph import neighbour_pull


class Surroundings(Protocol):
    """What a step asks about the world around the particles; times are those of the current step."""

    def sample(self, particles: Particles) -> WallSample | None:
        """Walls at the particles, or None where the scene has none."""

    def body_force(self, particles: Particles) -> Tensor | None:
        """Acceleration (N, D) by gravity and pressure sources, or None."""

    def shortfall(self, particles: Particles) -> Tensor:
        """By how much (N,), per time, the volume of a member's particles should grow to fill the cavity."""

    def later(self, particles: Particles, step: Tensor) -> Particles:
        """Go on in time by ``step`` (members,); the particles with what reservoirs prescribe then."""


@dataclass(frozen=True)
class RateSums:
    """Density rate (N,), velocity divergence (N,), crowding gradient (N, D) or None, and the raw sums."""

    rate: Tensor
    divergence: Tensor
    crowding: Tensor | None
    sums: Rates


class Stepper:
    """Steps particles with one scheme; holds no state but the neighbour list and the coefficients in use."""

    def __init__(
        self,
        scheme: WeaklyCompressible,
        coefficients: Coefficients,
        search: PairSearch,
        dimension: int,
        *,
        buffered: bool = True,
    ) -> None:
        """``buffered``: whether there can be particles of reservoirs, which are not the stepper's to move."""
        self.scheme, self.pair_search, self.dimension, self._buffered = scheme, search, dimension, buffered
        self.held_kinds: Tensor | None = None  # kinds of the buffers whose pressure, and so density, is given
        self.use(coefficients)

    def use(self, coefficients: Coefficients) -> None:
        """Step with these coefficients from now on."""
        self.coefficients, scheme = coefficients, self.scheme
        self.support = Support(kernel(scheme.kernel), coefficients.smoothing_length, self.dimension)
        moves = coefficients.xsph is not None and scheme.xsph.level == "position"
        self.position_xsph = coefficients.xsph if moves else None
        self.velocity_xsph = None if moves else coefficients.xsph
        self._centroid = coefficients.xsph is not None and scheme.xsph.form == "centroid"
        laminar = coefficients.viscosity
        if laminar is not None:
            laminar = laminar / softened_share(self.support.kernel, self.dimension)
        self.momentum_terms = MomentumTerms(
            pressure=scheme.pressure,
            artificial=coefficients.artificial,
            laminar=laminar,
            tensile=scheme.tensile,
        )
        self._corrected = coefficients.diffusion is not None and scheme.diffusion_form == "corrected"
        self._rate_terms = RateTerms(
            continuity=scheme.continuity,
            diffusion=coefficients.diffusion is not None and not self._corrected,
            concentration=coefficients.shifting is not None,
            xsph=moves and not self._centroid,
        )

    def step(
        self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
    ) -> tuple[Particles, Tensor, WallSample | None]:
        """Advance every member by its own ``step`` (members,), internal time, its ``number``-th (members,), from 1.

        Returns the particles, the acceleration (N, D) of the fluid that the next step's force limit needs, and the
        walls that the particles saw.
        """
        if self.scheme.order == "thesis":
            return self._thesis_step(particles, step, number, around)
        if self.scheme.order == "verlet":
            return verlet_step(self, particles, step, around)
        if self.scheme.order == "predictor_corrector":
            return predictor_corrector_step(self, particles, step, around)
        return self._symplectic_step(particles, step, number, around)

    def _symplectic_step(
        self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
    ) -> tuple[Particles, Tensor, WallSample | None]:
        """Both passes at the same position; velocity first, then position (symplectic Euler)."""
        dt = per_particle(step, particles.member)
        wall, seen = around.sample(particles), particles
        pairs = self.pair_search.at(particles)
        filtering = self._filter_due(number, step)
        terms = self._rate_terms if filtering is None else self._with_filter(self._rate_terms)
        rates = self._rates(particles, pairs, terms)
        compression, crowding = self._complete(particles, rates, wall)
        particles = self._new_density(particles, rates, compression, dt, filtering)
        acceleration = self.acceleration(particles, pairs, compression, wall, around)
        velocity = self.kicked(particles, particles.velocity, dt, acceleration)
        particles = self.retarded(particles.changed(velocity=velocity), wall, dt)
        drift = dt[:, None] * particles.velocity + self.wandering(particles, rates, crowding, step, seen)
        return particles.changed(position=particles.position + drift), acceleration, wall

    def wandering(
        self, particles: Particles, rates: Rates, crowding: Tensor | None, step: Tensor, seen: Particles
    ) -> Tensor:
        """What moves particles in a step beside their velocity: position XSPH and shifting, (N, D).

        ``seen`` is the state that the rates belong to.
        """
        drift = torch.zeros_like(particles.position)
        if self.position_xsph is not None:
            share = per_particle(step * self.position_xsph, particles.member)
            drift = drift + share[:, None] * self._xsph(seen, rates.xsph)
        if crowding is not None:
            drift = drift + shifting_displacement(
                particles,
                crowding,
                step,
                self.coefficients.smoothing_length,
                self.coefficients.shifting,
                self.scheme.shifting_speed == "largest",
                self.scheme.shifting_surface,
            )
        return self._of_fluid(particles, drift)

    def kicked(self, particles: Particles, velocity: Tensor, dt: Tensor, acceleration: Tensor) -> Tensor:
        """Velocities (N, D) after a kick; the buffers of reservoirs keep theirs."""
        return velocity + self._of_fluid(particles, dt[:, None] * acceleration)

    def _of_fluid(self, particles: Particles, values: Tensor) -> Tensor:
        """Values (N, ...) of the fluid's particles and 0 for those of reservoirs."""
        if not self._buffered:
            return values
        fluid = particles.fluid.reshape(-1, *[1] * (values.ndim - 1))
        return torch.where(fluid, values, torch.zeros_like(values))

    def _xsph(self, particles: Particles, plain: Tensor | None) -> Tensor:
        return neighbour_pull(particles, plain, self.support, self.pair_search, self._centroid)

    def evaluate_rates(self, particles: Particles, pairs: Any, wall: WallSample | None) -> RateSums:
        """Density rate and its companions at one state."""
        sums = self._rates(particles, pairs, self._rate_terms)
        divergence, crowding = self._complete(particles, sums, wall)
        return RateSums(self._density_rate(particles, sums, divergence), divergence, crowding, sums)

    def _thesis_step(
        self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings
    ) -> tuple[Particles, Tensor, WallSample | None]:
        """Algorithm 1 as printed: density and position with p^n, then forces at the new position, then XSPH.

        First order where forces depend on velocity or density (errata to algorithm 1); kept as the thesis's scheme.
        """
        dt = per_particle(step, particles.member)
        backend = self.pair_search.backend
        pairs = self.pair_search.at(particles)
        wall = around.sample(particles) if isinstance(self.scheme.wall, CompleteKernelWall) else None
        rates = self._rates(particles, pairs, self._rate_terms)
        compression, _ = self._complete(particles, rates, wall)
        particles = self._new_density(particles, rates, compression, dt)
        particles = particles.changed(position=particles.position + dt[:, None] * particles.velocity)
        pairs, wall = self.pair_search.at(particles), around.sample(particles)
        acceleration = self.acceleration(particles, pairs, compression, wall, around)
        particles = particles.changed(velocity=particles.velocity + dt[:, None] * acceleration)
        particles = self.retarded(particles, wall, dt)
        filtering = self._filter_due(number, step)
        smoothing = self.velocity_xsph is not None
        if smoothing or filtering is not None:
            plain = smoothing and not self._centroid and particles.confidence is None
            wanted = RateTerms(continuity=None, xsph=plain)
            wanted = wanted if filtering is None else self._with_filter(wanted)
            state = particles
            sums = backend.rates(pairs, self._pressureless(state), self.support, wanted)
            if smoothing:
                pull = self._xsph(state, sums.xsph)
                share = per_particle(self.velocity_xsph, particles.member)
                share = share[:, None] if isinstance(share, Tensor) else share
                particles = particles.changed(velocity=particles.velocity + share * pull)
            if filtering is not None:
                particles = particles.changed(deviation=self._filtered(particles, sums, filtering))
        return particles, acceleration, wall

    def _filter_due(self, number: Tensor, step: Tensor) -> Tensor | None:
        """Members (members,) bool whose density is filtered in this step, or None: no member's is."""
        period = self.scheme.shepard_period
        if period is None:
            return None
        due = (number % period == 0) & (step > 0)
        return due if bool(due.any()) else None

    def _with_filter(self, terms: RateTerms) -> RateTerms:
        """With the sums that the filter of the density needs."""
        return replace(terms, shepard=True, moments=self.scheme.density_filter == "mls")

    def _filtered(self, particles: Particles, sums: Rates, due: Tensor) -> Tensor:
        """Density deviation (N,) after the filter, in the members where ``due`` (members,)."""
        smooth = mls_deviation(sums) if self.scheme.density_filter == "mls" else shepard_deviation(sums)
        return torch.where(due[particles.member], smooth, particles.deviation)

    def _rates(self, particles: Particles, pairs: Any, terms: RateTerms) -> Rates:
        """First-pass sums, with the diffusion in the scheme's form."""
        backend, state = self.pair_search.backend, self._pressureless(particles)
        if not self._corrected:
            return backend.rates(pairs, state, self.support, terms)
        sums = backend.rates(pairs, state, self.support, replace(terms, gradient=True, renormalisation=True))
        slope = solve_small(sums.renormalisation, sums.gradient[:, :, None])[:, :, 0]
        second = RateTerms(None, corrected_diffusion=True)
        spread = backend.rates(pairs, replace(state, slope=slope), self.support, second).diffusion
        return replace(sums, diffusion=spread)

    @staticmethod
    def _pressureless(particles: Particles) -> Any:
        return particles.state(particles.deviation)

    def _complete(self, particles: Particles, rates: Rates, wall: WallSample | None) -> tuple[Tensor, Tensor | None]:
        """Velocity divergence and crowding gradient, complete at walls."""
        divergence = rates.divergence
        if self.scheme.continuity == "mass":
            divergence = divergence / (1.0 + particles.deviation)  # 2.19 gives the density rate, rho0 = 1
        return complete_rates(divergence, rates.concentration, particles.velocity, wall)

    def _new_density(
        self, particles: Particles, rates: Rates, divergence: Tensor, dt: Tensor, filtering: Tensor | None = None
    ) -> Particles:
        deviation = particles.deviation + dt * self._density_rate(particles, rates, divergence)
        if filtering is not None:
            deviation = self._filtered(particles.changed(deviation=deviation), rates, filtering)
        return particles.changed(deviation=deviation)

    def _density_rate(self, particles: Particles, rates: Rates, divergence: Tensor) -> Tensor:
        rate = -(1.0 + particles.deviation) * divergence
        if rates.diffusion is not None:
            c = self.coefficients
            spread = per_particle(c.diffusion * c.smoothing_length * c.sound_speed, particles.member)
            rate = rate + spread * rates.diffusion
        if self.scheme.constant_volume:
            mean = particles.per_member(rate, "sum") / particles.per_member(torch.ones_like(rate), "sum").clamp_min(1.0)
            rate = rate - per_particle(mean, particles.member)
        if self.held_kinds is not None:
            rate = torch.where(torch.isin(particles.kind, self.held_kinds), torch.zeros_like(rate), rate)
        return rate

    def at_pressure(self, particles: Particles, row: Tensor, pressure: Tensor) -> Particles:
        """Particles whose ``row`` (n,) have the density that the equation of state gives to ``pressure`` (n,)."""
        c, member = self.coefficients, particles.member[row]
        deviation = tait_deviation(pressure, per_particle(c.sound_speed, member), per_particle(c.gamma, member))
        return particles.changed(deviation=particles.deviation.index_copy(0, row, deviation))

    def pressure(self, particles: Particles, divergence: Tensor | None = None) -> Tensor:
        """p / rho0 (N,): equation of state, background (symmetric form only), damping of sound.

        Forms other than the symmetric one leave the background out: it must not change an incompressible flow.
        """
        c, member = self.coefficients, particles.member
        sound = per_particle(c.sound_speed, member)
        deviation = particles.deviation.clamp_min(0.0) if self.scheme.hughes_graham else particles.deviation
        pressure = tait_pressure(deviation, sound, per_particle(c.gamma, member))
        if self.scheme.pressure == "symmetric" and c.background is not None:
            pressure = pressure + per_particle(c.background, member) * sound**2
        if c.bulk_damping is not None and divergence is not None:
            damping = per_particle(c.bulk_damping * c.sound_speed * c.smoothing_length, member) * divergence
            pressure = pressure - self._of_fluid(particles, damping)
        return pressure

    def acceleration(
        self, particles: Particles, pairs: Any, divergence: Tensor, wall: WallSample | None, around: Surroundings
    ) -> Tensor:
        """Acceleration (N, D) by pairs, walls and body forces at one state."""
        pressure = self.pressure(particles, divergence)
        state = particles.state(pressure)
        acceleration = self.pair_search.backend.momentum(pairs, state, self.support, self.momentum_terms)
        body = around.body_force(particles)
        if wall is not None and wall.share is not None:
            acceleration = complete_forces(
                acceleration,
                particles.velocity,
                wall,
                member=particles.member,
                form=self.scheme.pressure,
                viscosity=self.coefficients.viscosity if self.scheme.wall.no_slip else None,
                pressure=pressure,
                deviation=particles.deviation,
            )
        elif wall is not None and isinstance(self.scheme.wall, PotentialWall):
            sound = per_particle(self.coefficients.sound_speed, particles.member)
            acceleration = acceleration + potential_force(self.scheme.wall, sound, wall)
        return acceleration if body is None else acceleration + body

    def retarded(self, particles: Particles, wall: WallSample | None, dt: Tensor) -> Particles:
        """Velocities slowed down by a potential wall with friction; other walls act through the acceleration."""
        model = self.scheme.wall
        if wall is None or not isinstance(model, PotentialWall) or model.relaxation is None:
            return particles
        sound = per_particle(self.coefficients.sound_speed, particles.member)
        velocity = retardation(model, sound, dt, particles.velocity, wall)
        return particles.changed(velocity=torch.where(particles.fluid[:, None], velocity, particles.velocity))
