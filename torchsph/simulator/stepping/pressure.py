"""Particles and what is around them at one moment: velocities without divergence, evened packings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchsph.pairs.interface import MomentumTerms, Rates, RateTerms, Support
from torchsph.pairs.poisson import PoissonSolution
from torchsph.pairs.vectors import inner, square_length

from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..walls.compiled import complete_rates
from ..walls.forces import SMALLEST_SHARE, WallSample
from .connected_parts import components

# densities that a source can react to: what is denser or thinner by more is a fault of another kind
_LARGEST_EXCESS = 0.3
_TINY = 1e-6
# classes of the kernel's share inside the walls, in which particles are compared
_SHARES = 16
# a displacement of more than this (spacings) would outrun the linearisation
_LARGEST_MOVE = 0.2
# part of a full kernel's moment below which no slope is drawn from what is left of it
_SMALLEST_MOMENT = 0.3
# cosine between the share's gradient and the wall's normal below which a wall is not plain
_EDGE = 0.9


@dataclass(frozen=True)
class Neighbourhood:
    """Particles with their neighbours, kernel and walls, at one moment."""

    particles: Particles
    search: PairSearch
    pairs: Any
    support: Support
    wall: WallSample | None

    @cached_property
    def share(self) -> Tensor | float:
        """Part of each kernel inside the walls, (N,)."""
        return 1.0 if self.wall is None else self.wall.share.clamp_min(SMALLEST_SHARE)

    def rates(self, terms: RateTerms) -> Rates:
        """First-pass sums."""
        state = self.particles.state(self.particles.deviation)
        return self.search.backend.rates(self.pairs, state, self.support, terms)

    def filling(self, sums: Rates) -> Tensor:
        """Number density relative to that of particles at rest density, (N,), from Shepard's sum."""
        return sums.shepard_volume / self.share

    def excess(self, filling: Tensor, counted: Tensor) -> Tensor:
        """Filling relative to the mean of the member's particles whose kernel is cut alike by walls, less 1: (N,).

        At walls particles stand in layers, where the sum is off by percents all the time: against one mean for all it
        would be a source without end, and drive a flow along the walls. It is 0 where not ``counted`` (N,) bool, and
        has no mean, so that it takes no part in what flows through a valve.
        """
        p = self.particles
        group = p.member
        if self.wall is not None:
            group = group * (_SHARES + 1) + (self.wall.share * _SHARES).to(torch.int64)
        weight = counted.to(filling.dtype)
        size = p.members * (_SHARES + 1)
        count = filling.new_zeros(size).index_add(0, group, weight)
        mean = filling.new_zeros(size).index_add(0, group, weight * filling) / count.clamp_min(1.0)
        excess = (filling / mean[group].clamp_min(_TINY) - 1.0).clamp(-_LARGEST_EXCESS, _LARGEST_EXCESS)
        return torch.where(counted, excess, torch.zeros_like(excess))

    def wall_jump(self) -> Tensor:
        """What the divergence at walls lacks, as a source (N,): half of the jump from the fluid's speed to the wall's.

        Of a jump at the wall the kernels of the fluid see the half that lies on their side; a wall that accelerates
        would so be followed by halves only. The fluid's normal velocity is continued linearly to the wall first, so
        that a flow that keeps to the wall has no jump. Meant for walls that move: what it adds to those at rest is
        noise at their edges.
        """
        p, wall = self.particles, self.wall
        steep = square_length(wall.share_gradient).sqrt()
        terms = MomentumTerms(pressure="difference")
        along = inner(p.velocity, wall.normal)
        fall = self.search.backend.momentum(self.pairs, p.state(along), self.support, terms)
        # the sum's own moment across a plane wall, by the divergence theorem
        moment = (wall.share - wall.distance * steep).clamp_min(_SMALLEST_MOMENT)
        rise = -inner(fall, wall.normal) / moment
        jump = inner(wall.velocity, wall.normal) - along + wall.distance.clamp_min(0.0) * rise
        # where walls meet at an edge there is no such line to continue on
        cosine = inner(wall.share_gradient, wall.normal) / steep.clamp_min(_TINY)
        plain = (cosine - _EDGE).clamp_min(0.0) / (1.0 - _EDGE)
        return torch.where(p.fluid, plain * jump * steep / self.share, torch.zeros_like(jump))

    def divergence(self, sums: Rates) -> tuple[Tensor, Tensor | None]:
        """Velocity divergence (N,) for the pressure to answer, and the crowding gradient (N, D), complete at walls."""
        p, wall = self.particles, self.wall
        divergence, crowding = complete_rates(sums.divergence, sums.concentration, p.velocity, wall)
        moves = wall is not None and bool(wall.velocity.any())
        return (divergence - self.wall_jump() if moves else divergence), crowding

    def push(
        self,
        source: Tensor,
        start: Tensor | None,
        surface: Tensor | None,
        tolerance: float,
        iterations: int,
        held: Tensor | None = None,
    ) -> tuple[Tensor, PoissonSolution]:
        """Solve -laplacian(u) = ``source`` (N,); minus the gradient of u (N, D), 0 in reservoirs, and the solution.

        Walls and buffers are impermeable to u (Neumann); where ``surface`` (N,) bool u is 0, where ``held`` (N,) bool,
        in buffers, it is as in ``start``.
        """
        p, backend = self.particles, self.search.backend
        state, fluid = p.state(p.deviation), p.fluid
        coupled = fluid if held is None else fluid | held
        bound = torch.zeros_like(fluid) if surface is None else surface
        source = source * self.share
        if held is not None:
            bound = bound | held
            kept = torch.where(held, start, torch.zeros_like(start))
            source = source - backend.laplacian(self.pairs, state, self.support, kept, coupled)[0]

        def solved(group: Tensor, groups: int) -> PoissonSolution:
            pinned = torch.zeros(groups, dtype=torch.int64, device=group.device).index_add(0, group, bound.long())
            return backend.poisson(
                self.pairs,
                state,
                self.support,
                source,
                start,
                free=fluid & ~bound,
                active=coupled,
                singular=pinned == 0,
                tolerance=tolerance,
                iterations=iterations,
                group=group,
            )

        found = solved(p.member, p.members)
        if not bool(found.converged.all()):
            found = self._by_parts(found, coupled, solved)
        if held is not None:
            found = replace(found, values=found.values + kept)
        if self.wall is not None:
            volume = torch.where(fluid, p.mass, torch.zeros_like(p.mass)).double()
            part = p.per_member(volume * self.share, "sum").clamp_min(_TINY)
            found = replace(found, mismatch=found.mismatch * p.per_member(volume, "sum") / part)
        # buffers take no part: the gradient by differences then continues the fluid's own pressure into them
        mass = p.mass if bool(coupled.all()) else torch.where(coupled, p.mass, torch.zeros_like(p.mass))
        state = p.changed(mass=mass).state(found.values)
        slope = backend.momentum(self.pairs, state, self.support, MomentumTerms(pressure="difference"))
        slope = slope / self.share[:, None] if self.wall is not None else slope
        slope = torch.where(fluid[:, None], slope, torch.zeros_like(slope))
        return (slope if self.wall is not None else self._without_thrust(slope)), found

    def _by_parts(
        self, found: PoissonSolution, coupled: Tensor, solved: Callable[[Tensor, int], PoissonSolution]
    ) -> PoissonSolution:
        """What ``solved`` finds where each part that hangs together has a constant of its own; ``found`` if all do.

        Looked for only where the solver failed: cavities in two halves and drops are rare, and finding them is slow.
        """
        p = self.particles
        part, count = components(p.position, p.member, coupled, self.support.radius, self.search.period)
        if count == p.members:
            return found
        apart = solved(part, count)
        owner = torch.zeros(count, dtype=torch.int64, device=part.device).index_copy(0, part, p.member)

        def of_members(values: Tensor, way: str, start: Tensor) -> Tensor:
            return start.scatter_reduce(0, owner, values, way)

        nothing = torch.zeros_like(found.residual)
        largest = of_members(apart.mismatch.abs(), "amax", nothing)
        return PoissonSolution(
            apart.values,
            of_members(apart.iterations, "amax", found.iterations),
            of_members(apart.residual, "amax", nothing),
            of_members(apart.converged.long(), "amin", torch.ones_like(found.iterations)) > 0,
            largest,
        )

    def _without_thrust(self, push: Tensor) -> Tensor:
        """``push`` (N, D) without its mean: pressure inside a fluid that touches nothing cannot move it as a whole.

        The gradient by differences is exact for a constant pressure but, unlike the symmetric one, not antisymmetric.
        """
        p = self.particles
        mass = p.per_member(p.mass, "sum").clamp_min(_TINY)
        thrust = push.new_zeros((p.members, push.shape[1])).index_add(0, p.member, p.mass[:, None] * push)
        return push - (thrust / mass[:, None]).index_select(0, p.member)


def divergence_free(
    around: Neighbourhood, *, times: int = 1, tolerance: float = 1e-3, iterations: int = 200
) -> tuple[Tensor, PoissonSolution]:
    """Velocities (N, D) of the fluid nearest to the present ones without divergence, after ``times`` projections.

    The projection is approximate (Cummins & Rudman 1999 section 3): the operator solved is not the divergence of the
    gradient, so a second one takes away much of what the first has left.
    """
    particles = around.particles
    for _ in range(times):
        now = Neighbourhood(particles, around.search, around.pairs, around.support, around.wall)
        divergence, _ = now.divergence(now.rates(RateTerms()))
        push, found = now.push(-divergence, None, None, tolerance, iterations)
        particles = particles.changed(velocity=particles.velocity + push)
    return particles.velocity, found


def packing(around: Neighbourhood, *, tolerance: float = 3e-2, iterations: int = 30) -> tuple[Tensor, Tensor]:
    """Displacements (N, D) of the fluid that even out its number density to first order, and its excess (N,) before.

    The displacement is minus the gradient of a potential whose Laplacian is the excess: one Newton step towards a
    packing that shifting would take hundreds of sweeps to reach.
    """
    excess = around.filling(around.rates(RateTerms(continuity=None, shepard=True))) - 1.0
    move, _ = around.push(excess.clamp(-_LARGEST_EXCESS, _LARGEST_EXCESS), None, None, tolerance, iterations)
    length = move.norm(dim=1, keepdim=True)
    return move * (_LARGEST_MOVE / length.clamp_min(_LARGEST_MOVE)), excess
