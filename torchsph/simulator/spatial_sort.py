"""Large sets of particles in the order of their places, so that neighbours lie side by side in memory."""

from __future__ import annotations

import torch
from torch import Tensor

from .state.neighbour_list import PairSearch
from .state.particles import Particles

# from so many particles on they are sorted in space, every so many searches: smaller sets fit into the caches anyway
_SORT_FROM, _SORT_EVERY = 50_000, 8


class SpatialSort:
    """Sorts the particles of a run while it advances, and puts them back into the caller's order afterwards.

    Attributes:
        order: (N,) int64, of the particles in space when they were last sorted, or None.
    """

    def __init__(self, search: PairSearch) -> None:
        self._search = search
        self.order: Tensor | None = None
        self._sort_at = 0  # number of searches at which they are sorted again

    def begin(self, particles: Particles, acceleration: Tensor) -> tuple[Particles, Tensor]:
        """Particles and their accelerations (N, D) in the order of the last time, where there are many."""
        if particles.count < _SORT_FROM:
            return particles, acceleration
        return self._sorted(particles.labelled(), acceleration, self.order)

    def when_due(self, particles: Particles, acceleration: Tensor) -> tuple[Particles, Tensor]:
        """The same sorted anew now and then, where the neighbours are to be searched anyway."""
        due = particles.count >= _SORT_FROM and self._search.searches >= self._sort_at
        if due and self._search.stale(particles):
            particles, acceleration = self._sorted(particles, acceleration, self._search.spatial_order(particles))
            self._sort_at = self._search.searches + _SORT_EVERY
        return particles, acceleration

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
