"""Particles and what is around them at one moment: velocities without divergence, evened packings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchsph.pairs.interface import MomentumTerms, Rates, RateTerms, Support
from torchsph.pairs.poisson import PoissonSolution
from torchsph.pairs.vectors import inner, norm

from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..state.required import required
from ..walls.compiled import complete_rates
from ..walls.formulas import SMALLEST_COMPLETENESS
from ..walls.interface import CompleteWallSample, WallSample, complete_sample
from .connected_parts import components

# densities that a source can react to: what is denser or thinner by more is a fault of another kind
_LARGEST_EXCESS = 0.3
# volumes and lengths are divided by nothing smaller
_SMALLEST = 1e-6
# classes of the kernel's completeness, in which particles are compared
_CLASSES = 16
# a displacement of more than this (spacings) would outrun the linearisation
_LONGEST_MOVE = 0.2
# part of a full kernel's moment below which no slope is drawn from what is left of it
_SMALLEST_MOMENT = 0.3
# cosine between the completeness's gradient and the wall's normal below which a wall is not plain
_EDGE = 0.9


@dataclass(frozen=True)
class _Problem:
    """One pressure equation; arrays (N,), the masks bool."""

    source: Tensor
    start: Tensor | None
    bound: Tensor  # where the potential is given
    coupled: Tensor  # particles that take part
    tolerance: float
    iterations: int


@dataclass(frozen=True)
class Neighbourhood:
    """Particles with their neighbours, kernel and walls, at one moment.

    Attributes:
        particles: at the moment.
        search: neighbour list.
        pairs: neighbours, as the backend's search gave them.
        support: kernel and smoothing length.
        wall: walls at the particles, of a model that is complete, or None.
    """

    particles: Particles
    search: PairSearch
    pairs: Any
    support: Support
    wall: WallSample | None

    @cached_property
    def complete_wall(self) -> CompleteWallSample | None:
        """Walls at the particles, with the kernel's completeness; None without walls.

        Raises:
            ValueError: the walls come without it.
        """
        return None if self.wall is None else complete_sample(self.wall)

    @cached_property
    def completeness(self) -> Tensor | None:
        """Part of each kernel inside the walls, (N,), at least ``SMALLEST_COMPLETENESS``; None without walls."""
        wall = self.complete_wall
        return None if wall is None else wall.completeness.clamp_min(SMALLEST_COMPLETENESS)

    def rates(self, terms: RateTerms) -> Rates:
        """First-pass sums."""
        state = self.particles.state(self.particles.deviation)
        return self.search.backend.rates(self.pairs, state, self.support, terms)

    def filling(self, sums: Rates) -> Tensor:
        """Number density relative to that of particles at rest density, (N,), from Shepard's sum."""
        volume = required(sums.shepard_volume, "Shepard's sum")
        return volume if self.completeness is None else volume / self.completeness

    def excess(self, filling: Tensor, counted: Tensor) -> Tensor:
        """Filling relative to the mean of the member's particles whose kernel is cut alike by walls, less 1.

        At walls particles stand in layers, where the sum is off by percents all the time: against one mean for all it
        would be a source without end, and drive a flow along the walls. It has no mean, so that it takes no part in
        what flows through a valve.

        Args:
            filling: (N,).
            counted: (N,) bool, particles that count; the others have no excess.

        Returns:
            (N,).
        """
        p, weight = self.particles, counted.to(filling.dtype)
        classes = 1 if self.complete_wall is None else _CLASSES
        place = torch.zeros_like(filling)
        if self.complete_wall is not None:
            place = (self.complete_wall.completeness * _CLASSES - 0.5).clamp(0.0, _CLASSES - 1.0)
        # between two classes a particle belongs to both by its distance: no particle's source may jump
        low = place.detach().floor().clamp_max(max(classes - 2, 0)).to(torch.int64)
        upper = place - low
        rows = [p.member * classes + (low + step).clamp_max(classes - 1) for step in (0, 1)]
        parts = [1.0 - upper, upper]
        count = total = filling.new_zeros(p.members * classes)
        for row, part in zip(rows, parts, strict=True):
            count = count.index_add(0, row, weight * part)
            total = total.index_add(0, row, weight * part * filling)
        mean = torch.where(count > 0, total / count.clamp_min(_SMALLEST), torch.ones_like(count))
        level = parts[0] * mean[rows[0]] + parts[1] * mean[rows[1]]
        excess = (filling / level.clamp_min(_SMALLEST) - 1.0).clamp(-_LARGEST_EXCESS, _LARGEST_EXCESS)
        excess = torch.where(counted, excess, torch.zeros_like(excess))
        rest = p.per_member(excess, "sum") / p.per_member(weight, "sum").clamp_min(1.0)
        return excess - torch.where(counted, rest.index_select(0, p.member), torch.zeros_like(excess))

    def _wall_jump(self, wall: CompleteWallSample) -> Tensor:
        """What the divergence at walls lacks, as a source (N,): half of the jump from the fluid's speed to the wall's.

        Of a jump at the wall the kernels of the fluid see the half that lies on their side; a wall that accelerates
        would so be followed by halves only. The fluid's normal velocity is continued linearly to the wall first, so
        that a flow that keeps to the wall has no jump. Meant for walls that move: what it adds to those at rest is
        noise at their edges.
        """
        p = self.particles
        steep = norm(wall.completeness_gradient)
        terms = MomentumTerms(pressure="difference")
        along = inner(p.velocity, wall.normal)
        fall = self.search.backend.momentum(self.pairs, p.state(along), self.support, terms)
        # the sum's own moment across a plane wall, by the divergence theorem
        moment = (wall.completeness - wall.distance * steep).clamp_min(_SMALLEST_MOMENT)
        rise = -inner(fall, wall.normal) / moment
        jump = inner(wall.velocity, wall.normal) - along + wall.distance.clamp_min(0.0) * rise
        # where walls meet at an edge there is no such line to continue on
        cosine = inner(wall.completeness_gradient, wall.normal) / steep.clamp_min(_SMALLEST)
        plain = (cosine - _EDGE).clamp_min(0.0) / (1.0 - _EDGE)
        source = plain * jump * steep / wall.completeness.clamp_min(SMALLEST_COMPLETENESS)
        return torch.where(p.fluid, source, torch.zeros_like(jump))

    def divergence(self, sums: Rates) -> tuple[Tensor, Tensor | None]:
        """Velocity divergence (N,) for the pressure to answer, and the gradient (N, D) of the concentration.

        Both are complete at walls; the gradient is None where ``sums`` lack it.
        """
        wall, divergence = self.complete_wall, required(sums.divergence, "the velocity's divergence")
        if wall is None:
            return divergence, sums.concentration
        divergence, gradient = complete_rates(divergence, sums.concentration, self.particles.velocity, wall)
        return (divergence - self._wall_jump(wall) if bool(wall.velocity.any()) else divergence), gradient

    def project(
        self,
        source: Tensor,
        start: Tensor | None,
        surface: Tensor | None,
        tolerance: float,
        iterations: int,
        prescribed: Tensor | None = None,
    ) -> tuple[Tensor, PoissonSolution]:
        """Solve -laplacian(u) = ``source``; walls and buffers are impermeable to u (Neumann).

        Args:
            source: (N,).
            start: (N,), first guess of u, or None.
            surface: (N,) bool, where u is 0, or None: nowhere.
            tolerance: of the residual relative to the source.
            iterations: at most.
            prescribed: (N,) bool, in buffers, where u is as in ``start``, or None: nowhere.

        Returns:
            Minus the gradient of u (N, D), 0 in reservoirs, and the solution.
        """
        p, fluid = self.particles, self.particles.fluid
        coupled = fluid if prescribed is None else fluid | prescribed
        bound = torch.zeros_like(fluid) if surface is None else surface
        source, fixed = source if self.completeness is None else source * self.completeness, None
        if prescribed is not None:
            bound = bound | prescribed
            fixed = torch.where(prescribed, required(start, "the pressure of the buffers"), torch.zeros_like(source))
            state = p.state(p.deviation)
            source = source - self.search.backend.laplacian(self.pairs, state, self.support, fixed, coupled)[0]
        problem = _Problem(source, start, bound, coupled, tolerance, iterations)
        found = self._solve(problem, p.member, p.members)
        if not bool(found.converged.all()):
            found = self._solve_by_parts(problem, found)
        if fixed is not None:
            found = replace(found, values=found.values + fixed)
        if self.completeness is not None:
            volume = torch.where(fluid, p.mass, torch.zeros_like(p.mass)).double()
            part = p.per_member(volume * self.completeness, "sum").clamp_min(_SMALLEST)
            found = replace(found, mismatch=found.mismatch * p.per_member(volume, "sum") / part)
        return self._descent(found.values, coupled), found

    def _solve(self, problem: _Problem, group: Tensor, groups: int) -> PoissonSolution:
        """The backend's solution, where each of the ``groups`` in ``group`` (N,) int64 stands alone."""
        p = self.particles
        pinned = torch.zeros(groups, dtype=torch.int64, device=group.device).index_add(0, group, problem.bound.long())
        return self.search.backend.poisson(
            self.pairs,
            p.state(p.deviation),
            self.support,
            problem.source,
            problem.start,
            free=p.fluid & ~problem.bound,
            active=problem.coupled,
            singular=pinned == 0,
            tolerance=problem.tolerance,
            iterations=problem.iterations,
            group=group,
        )

    def _solve_by_parts(self, problem: _Problem, found: PoissonSolution) -> PoissonSolution:
        """The solution where each part that hangs together has a constant of its own; ``found`` if all do.

        Looked for only where the solver failed: cavities in two halves and drops are rare, and finding them is slow.
        """
        p = self.particles
        part, count = components(p.position, p.member, problem.coupled, self.support.radius, self.search.period)
        if count == p.members:
            return found
        apart = self._solve(problem, part, count)
        owner = torch.zeros(count, dtype=torch.int64, device=part.device).index_copy(0, part, p.member)

        def of_members(values: Tensor, reduce: str, start: Tensor) -> Tensor:
            return start.scatter_reduce(0, owner, values, reduce)

        nothing = torch.zeros_like(found.residual)
        largest = of_members(apart.mismatch.abs(), "amax", nothing)
        return PoissonSolution(
            apart.values,
            of_members(apart.iterations, "amax", found.iterations),
            of_members(apart.residual, "amax", nothing),
            of_members(apart.converged.long(), "amin", torch.ones_like(found.iterations)) > 0,
            largest,
        )

    def _descent(self, potential: Tensor, coupled: Tensor) -> Tensor:
        """Minus the gradient (N, D) of ``potential`` (N,), complete at walls, 0 in reservoirs."""
        p = self.particles
        # buffers take no part: the gradient by differences then continues the fluid's own pressure into them
        mass = torch.where(coupled, p.mass, torch.zeros_like(p.mass))
        terms = MomentumTerms(pressure="difference")
        slope = self.search.backend.momentum(self.pairs, p.changed(mass=mass).state(potential), self.support, terms)
        slope = slope if self.completeness is None else slope / self.completeness[:, None]
        slope = torch.where(p.fluid[:, None], slope, torch.zeros_like(slope))
        return slope if self.wall is not None else self._without_thrust(slope)

    def _without_thrust(self, acceleration: Tensor) -> Tensor:
        """``acceleration`` (N, D) without its mean: pressure in a fluid that touches nothing cannot move it as a whole.

        The gradient by differences is exact for a constant pressure but, unlike the symmetric one, not antisymmetric.
        """
        p = self.particles
        mass = p.per_member(p.mass, "sum").clamp_min(_SMALLEST)
        total = acceleration.new_zeros((p.members, acceleration.shape[1]))
        thrust = total.index_add(0, p.member, p.mass[:, None] * acceleration)
        return acceleration - (thrust / mass[:, None]).index_select(0, p.member)


def divergence_free(around: Neighbourhood, *, times: int = 1, tolerance: float = 1e-3, iterations: int = 200) -> Tensor:
    """Velocities of the fluid nearest to the present ones without divergence, after some projections.

    The projection is approximate (Cummins & Rudman 1999, sec. 3): the operator solved is not the divergence of the
    gradient, so a second one takes away much of what the first has left.

    Args:
        around: the particles and what is around them.
        times: projections.
        tolerance: of each, of the residual relative to the source.
        iterations: of each, at most.

    Returns:
        (N, D), internal.
    """
    particles = around.particles
    for _ in range(times):
        present = replace(around, particles=particles)
        divergence, _ = present.divergence(present.rates(RateTerms()))
        source = -divergence if particles.exchange is None else particles.exchange - divergence
        change, _ = present.project(source, None, None, tolerance, iterations)
        particles = particles.changed(velocity=particles.velocity + change)
    return particles.velocity


def packing(around: Neighbourhood, *, tolerance: float = 3e-2, iterations: int = 30) -> tuple[Tensor, Tensor]:
    """Displacements (N, D) of the fluid that even out its number density to first order, and its excess (N,) before.

    The displacement is minus the gradient of a potential whose Laplacian is the excess: one Newton step towards a
    packing that shifting would take hundreds of sweeps to reach.

    Args:
        around: the particles and what is around them.
        tolerance: of the residual relative to the source.
        iterations: at most.
    """
    excess = around.filling(around.rates(RateTerms(continuity=None, shepard=True))) - 1.0
    source = excess.clamp(-_LARGEST_EXCESS, _LARGEST_EXCESS)
    move, _ = around.project(source, None, None, tolerance, iterations)
    length = move.norm(dim=1, keepdim=True)
    return move * (_LONGEST_MOVE / length.clamp_min(_LONGEST_MOVE)), excess
