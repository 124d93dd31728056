"""Large sets of particles in the order of their places, so that neighbours lie side by side in memory."""

from __future__ import annotations

import torch
from torch import Tensor

from .state.neighbour_list import PairSearch
from .state.particles import Particles

# members of so many particles are sorted in space, every so many searches: smaller sets fit into the caches anyway
_SORT_FROM, _SORT_EVERY = 50_000, 8


class SpatialSort:
    """Sorts the particles of a run while it advances, and puts them back into the caller's order afterwards.

    Each member is sorted or not for itself: in which order its sums run depends on nobody else.

    Attributes:
        order: (N,) int64, of the particles in space when they were last sorted, or None.
    """

    def __init__(self, search: PairSearch) -> None:
        self._search = search
        self.order: Tensor | None = None
        self._sort_at: Tensor | None = None  # (members,) number of searches at which they are sorted again

    def begin(self, particles: Particles, acceleration: Tensor) -> tuple[Particles, Tensor]:
        """Particles and their accelerations (N, D) in the order of the last time, where there are many."""
        if _large(particles) is None:
            return particles, acceleration
        return self._sorted(particles.labelled(), acceleration, self.order)

    def when_due(self, particles: Particles, acceleration: Tensor) -> tuple[Particles, Tensor]:
        """The same sorted anew now and then, where the neighbours are to be searched anyway."""
        due = _large(particles)
        if due is None:
            return particles, acceleration
        if self._sort_at is not None and self._search.renewed is not None:
            due &= self._search.renewed >= self._sort_at
        due &= self._search.stale(particles)
        if bool(due.any()):
            order = self._search.spatial_order(particles)
            particles, acceleration = self._sorted(particles, acceleration, _of_members(due, particles, order))
            self._schedule(due)
        return particles, acceleration

    def _schedule(self, sorted_now: Tensor) -> None:
        renewed = self._search.renewed
        if renewed is None:
            return
        earlier = torch.zeros_like(renewed) if self._sort_at is None else self._sort_at
        self._sort_at = torch.where(sorted_now, renewed + _SORT_EVERY, earlier)

    def _sorted(self, particles: Particles, acceleration: Tensor, order: Tensor | None) -> tuple[Particles, Tensor]:
        """In an order (N,), with labels that tell the caller's; unchanged where it does not fit."""
        if order is None or len(order) != particles.count:
            return particles, acceleration
        particles = particles if particles.label is not None else particles.labelled()
        self._search.forget()
        return particles.select(order), acceleration[order]

    def end(self, particles: Particles, acceleration: Tensor) -> tuple[Particles, Tensor]:
        """The same in the caller's order; the order in space is kept for the next time."""
        self.order = None
        if particles.label is None:
            return particles, acceleration
        back = torch.argsort(particles.label, stable=True)
        self.order = torch.argsort(back)
        return particles.by_label(), acceleration[back]


def _large(particles: Particles) -> Tensor | None:
    """(members,) bool: who has enough particles to be sorted; None: nobody."""
    if particles.count < _SORT_FROM:
        return None
    large = torch.bincount(particles.member, minlength=particles.members) >= _SORT_FROM
    return large if bool(large.any()) else None


def _of_members(members: Tensor, particles: Particles, order: Tensor | None) -> Tensor | None:
    """The order (N,) for the particles of ``members`` (members,) bool; the others keep theirs, member by member."""
    if order is None or bool(members.all()):
        return order
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device)
    key = torch.where(members[particles.member], rank, torch.arange(len(order), device=order.device))
    found = torch.argsort(key)
    return found[torch.argsort(particles.member[found], stable=True)]
