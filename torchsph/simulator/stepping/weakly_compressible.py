"""The sums of the weakly compressible scheme: rates, density, pressure and acceleration at one state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchsph.pairs.interface import MomentumTerms, Rates, RateTerms, Support
from torchsph.pairs.moving_least_squares import solve_small
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.pairs.vectors import column, per_particle

from ..schemes.weakly_compressible import WeaklyCompressible
from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..state.required import required
from ..walls.interface import FluidAtWalls, WallSample
from ..walls.registry import wall_forces
from .coefficients import Coefficients
from .density_filter import DensityFilter
from .protocols import Surroundings
from .shifting import Shifting
from .terms import softened_share, tait_deviation, tait_pressure
from .xsph import xsph_sum


@dataclass(frozen=True)
class RateSums:
    """What the first pass over the pairs says of a state.

    Attributes:
        density: (N,), rate of the density deviation.
        divergence: (N,), of the velocity, complete at walls.
        concentration_gradient: (N, D), complete at walls, or None where nothing is shifted.
        sums: as the backend gave them.
    """

    density: Tensor
    divergence: Tensor
    concentration_gradient: Tensor | None
    sums: Rates


class WeaklyCompressibleSums:
    """What the order of a step is made of; holds no state but the neighbour list and the coefficients in use.

    Args:
        scheme: options.
        coefficients: of the run, internal units.
        search: neighbour list.
        dimension: 2 or 3.
        buffered: whether there can be particles of reservoirs, which are not the step's to move.
    """

    def __init__(
        self,
        scheme: WeaklyCompressible,
        coefficients: Coefficients,
        search: PairSearch,
        dimension: int,
        *,
        buffered: bool = True,
    ) -> None:
        self.scheme, self.pair_search, self.dimension, self._buffered = scheme, search, dimension, buffered
        self.prescribed_kinds: Tensor | None = None  # kinds of the buffers whose pressure, and so density, is given
        self.density_filter = DensityFilter.of(scheme)
        self.walls = wall_forces(scheme.wall)
        self.use(coefficients)

    def use(self, coefficients: Coefficients) -> None:
        """Step with these coefficients from now on."""
        self.coefficients, scheme = coefficients, self.scheme
        xsph = None if coefficients.xsph is None else scheme.xsph
        self.support = Support(kernel(scheme.kernel), coefficients.smoothing_length, self.dimension)
        self.shifting = Shifting.of(scheme, coefficients)
        self._centroid = xsph is not None and xsph.form == "centroid"
        moves = xsph is not None and xsph.level == "position"
        self.position_xsph = coefficients.xsph if moves else None
        self.velocity_xsph = None if moves else coefficients.xsph
        laminar = coefficients.viscosity
        if laminar is not None:
            laminar = laminar / softened_share(self.support.kernel, self.dimension)
        self._momentum_terms = MomentumTerms(
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

    def rates(
        self, particles: Particles, pairs: Any, wall: WallSample | None, filtering: Tensor | None = None
    ) -> RateSums:
        """Density rate and its companions at one state.

        Args:
            particles: at which the sums are taken.
            pairs: neighbours, as the backend's search gave them.
            wall: walls at the particles, or None.
            filtering: (members,) bool, whose density is to be filtered with these sums, or None: no member's.
        """
        terms = self._rate_terms
        if filtering is not None and self.density_filter is not None:
            terms = self.density_filter.terms(terms)
        sums = self._first_pass(particles, pairs, terms)
        divergence = required(sums.divergence, "the velocity's divergence")
        if self.scheme.continuity == "mass":
            divergence = divergence / (1.0 + particles.deviation)  # Grønli 2017, eq. 2.19, is the density's, rho0 = 1
        gradient = sums.concentration
        if wall is not None:
            divergence, gradient = self.walls.complete_rates(divergence, gradient, particles.velocity, wall)
        return RateSums(self._density_rate(particles, sums, divergence), divergence, gradient, sums)

    def _first_pass(self, particles: Particles, pairs: Any, terms: RateTerms) -> Rates:
        """First-pass sums, with the diffusion in the scheme's form."""
        backend, state = self.pair_search.backend, particles.state(particles.deviation)
        if not self._corrected:
            return backend.rates(pairs, state, self.support, terms)
        sums = backend.rates(pairs, state, self.support, replace(terms, gradient=True, renormalisation=True))
        gradient = required(sums.gradient, "the density's gradient")
        slope = solve_small(required(sums.renormalisation, "the renormalisation"), gradient[:, :, None])[:, :, 0]
        second = RateTerms(None, corrected_diffusion=True)
        spread = backend.rates(pairs, replace(state, slope=slope), self.support, second).diffusion
        return replace(sums, diffusion=spread)

    def _density_rate(self, particles: Particles, sums: Rates, divergence: Tensor) -> Tensor:
        rate = -(1.0 + particles.deviation) * divergence
        c = self.coefficients
        if sums.diffusion is not None and c.diffusion is not None:
            spread = per_particle(c.diffusion * c.smoothing_length * c.sound, particles.member)
            rate = rate + spread * sums.diffusion
        if self.scheme.constant_volume:
            mean = particles.per_member(rate, "sum") / particles.per_member(torch.ones_like(rate), "sum").clamp_min(1.0)
            rate = rate - per_particle(mean, particles.member)
        if self.prescribed_kinds is not None:
            rate = torch.where(torch.isin(particles.kind, self.prescribed_kinds), torch.zeros_like(rate), rate)
        return rate

    def thinned(self, particles: Particles, change: Tensor) -> Particles:
        """Particles whose density has changed by ``change`` (N,), none of them thinner than the scheme lets it be."""
        deviation, least = particles.deviation + change, self.scheme.least_density
        return particles.changed(deviation=deviation if least is None else deviation.clamp_min(least - 1.0))

    def pressure(self, particles: Particles, divergence: Tensor | None = None) -> Tensor:
        """p / rho0 (N,): equation of state, background (symmetric form only), damping of sound.

        Forms other than the symmetric one leave the background out: it must not change an incompressible flow.

        Args:
            particles: whose density counts.
            divergence: (N,), of the velocity, for the damping; None: without.
        """
        c, member = self.coefficients, particles.member
        sound = per_particle(c.sound, member)
        deviation = particles.deviation.clamp_min(0.0) if self.scheme.hughes_graham else particles.deviation
        pressure = tait_pressure(deviation, sound, per_particle(c.exponent, member))
        if self.scheme.pressure == "symmetric" and c.background is not None:
            pressure = pressure + per_particle(c.background, member) * sound**2
        if c.bulk_damping is not None and divergence is not None:
            damping = per_particle(c.bulk_damping * c.sound * c.smoothing_length, member) * divergence
            pressure = pressure - self.of_fluid(particles, damping)
        return pressure

    def at_pressure(self, particles: Particles, row: Tensor, pressure: Tensor) -> Particles:
        """Particles whose ``row`` (n,) have the density that the equation of state gives to ``pressure`` (n,)."""
        c, member = self.coefficients, particles.member[row]
        deviation = tait_deviation(pressure, per_particle(c.sound, member), per_particle(c.exponent, member))
        return particles.changed(deviation=particles.deviation.index_copy(0, row, deviation))

    def acceleration(
        self, particles: Particles, pairs: Any, divergence: Tensor, wall: WallSample | None, around: Surroundings
    ) -> Tensor:
        """Acceleration by pairs, walls and body forces at one state.

        Args:
            particles: at which the forces are taken.
            pairs: neighbours, as the backend's search gave them.
            divergence: (N,), of the velocity, complete at walls.
            wall: walls at the particles, or None.
            around: whose body forces act.

        Returns:
            (N, D), internal.
        """
        pressure = self.pressure(particles, divergence)
        state = particles.state(pressure)
        acceleration = self.pair_search.backend.momentum(pairs, state, self.support, self._momentum_terms)
        body = around.body_force(particles)
        if wall is not None:
            acceleration = self.walls.accelerate(acceleration, self._at_walls(particles, pressure), wall)
        return acceleration if body is None else acceleration + body

    def kick(self, particles: Particles, velocity: Tensor, dt: Tensor, acceleration: Tensor) -> Tensor:
        """Velocities (N, D) after a kick; the buffers of reservoirs keep theirs.

        Args:
            particles: whose velocities they are.
            velocity: (N, D), before.
            dt: (N,), length of the kick, internal.
            acceleration: (N, D), internal.
        """
        return velocity + self.of_fluid(particles, dt[:, None] * acceleration)

    def damp_at_walls(self, particles: Particles, wall: WallSample | None, dt: Tensor) -> Particles:
        """Particles slowed down over ``dt`` (N,) by walls whose friction is no acceleration."""
        if wall is None:
            return particles
        velocity = self.walls.damp(self._at_walls(particles), wall, dt)
        if velocity is particles.velocity:
            return particles
        return particles.changed(velocity=torch.where(particles.fluid[:, None], velocity, particles.velocity))

    def _at_walls(self, particles: Particles, pressure: Tensor | None = None) -> FluidAtWalls:
        c = self.coefficients
        return FluidAtWalls(
            particles.velocity,
            particles.deviation,
            particles.member,
            form=self.scheme.pressure,
            pressure=pressure,
            sound_speed=c.sound_speed,
            viscosity=c.viscosity,
        )

    def position_correction(self, particles: Particles, rates: RateSums, seen: Particles, step: Tensor) -> Tensor:
        """What moves particles in a step beside their velocity: position XSPH and shifting.

        Args:
            particles: with the velocity that limits the shift.
            rates: sums of the step.
            seen: the state that ``rates`` belong to.
            step: (members,), internal time.

        Returns:
            (N, D), internal, 0 for the buffers of reservoirs.
        """
        drift = torch.zeros_like(particles.position)
        if self.position_xsph is not None:
            factor = per_particle(step * self.position_xsph, particles.member)
            drift = drift + factor[:, None] * self._xsph(seen, rates.sums.xsph)
        if self.shifting is not None and rates.concentration_gradient is not None:
            drift = drift + self.shifting.displacement(particles, rates.concentration_gradient, step)
        return self.of_fluid(particles, drift)

    def smooth_velocity(self, particles: Particles, pairs: Any, filtering: Tensor | None) -> Particles:
        """Particles after velocity XSPH (Grønli 2017, eq. 2.34) and the filter of the density, from one pass.

        Args:
            particles: after the step.
            pairs: their neighbours, as the backend's search gave them.
            filtering: (members,) bool, whose density is filtered, or None: no member's.
        """
        smoothing = self.velocity_xsph is not None
        if not smoothing and filtering is None:
            return particles
        wanted = RateTerms(continuity=None, xsph=smoothing and not self._centroid and particles.confidence is None)
        if filtering is not None and self.density_filter is not None:
            wanted = self.density_filter.terms(wanted)
        state = particles.state(particles.deviation)
        sums = self.pair_search.backend.rates(pairs, state, self.support, wanted)
        if self.velocity_xsph is not None:
            difference = self._xsph(particles, sums.xsph)
            factor = column(per_particle(self.velocity_xsph, particles.member))
            particles = particles.changed(velocity=particles.velocity + factor * difference)
        return self.filter_density(particles, sums, filtering)

    def filter_due(self, number: Tensor, step: Tensor) -> Tensor | None:
        """Members (members,) bool whose density is filtered in this step, or None: no member's is."""
        return None if self.density_filter is None else self.density_filter.due(number, step)

    def filter_density(self, particles: Particles, sums: Rates, filtering: Tensor | None) -> Particles:
        """Particles with the density filtered in the members where ``filtering`` (members,) bool."""
        if filtering is None or self.density_filter is None:
            return particles
        return self.density_filter.apply(particles, sums, filtering)

    def of_fluid(self, particles: Particles, values: Tensor) -> Tensor:
        """Values (N, ...) of the fluid's particles and 0 for those of reservoirs."""
        if not self._buffered:
            return values
        fluid = particles.fluid.reshape(-1, *[1] * (values.ndim - 1))
        return torch.where(fluid, values, torch.zeros_like(values))

    def _xsph(self, particles: Particles, plain: Tensor | None) -> Tensor:
        return xsph_sum(particles, plain, self.support, self.pair_search, self._centroid)
