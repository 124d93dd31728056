"""The neighbours of a run's particles: found anew only where the particles have moved too far for the old list."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsph.pairs.interface import Backend
from torchsph.pairs.vectors import square_length

from .particles import Particles


@dataclass
class PairSearch:
    """The neighbour list and where the particles were when it was made.

    One list serves all members, but each member's part of it changes only when that member has moved too far: the
    others are listed again as they were, so that no member's sums depend on its company in a batch.

    Attributes:
        backend: makes the lists.
        radius: of the support, internal.
        margin: how far beyond it the lists reach, internal.
        period: (D,) lengths of a periodic box, internal, or None.
        pairs: the present list, as the backend gave it.
        made_for: the particles of the present list, at the places for which it was made.
        searches: how often a list was made.
        renewed: (members,) int64, how often a member's own part was; None before the first.
    """

    backend: Backend
    radius: float
    margin: float
    period: Tensor | None = None
    pairs: Any = None
    made_for: Particles | None = None
    searches: int = 0
    renewed: Tensor | None = None

    def apart(self) -> PairSearch:
        """A search like this one that has found nothing yet."""
        return PairSearch(self.backend, self.radius, self.margin, self.period)

    def stale(self, particles: Particles) -> Tensor:
        """(members,) bool: whose particles have moved, or changed in number, beyond what the list allows for."""
        return self._stale(particles, self._listed(particles))

    def at(self, particles: Particles) -> Any:
        """Pairs that are valid at the particles' present positions."""
        listed = self._listed(particles)
        stale = self._stale(particles, listed)
        if listed is None or listed is not self.made_for or bool(stale.any()):
            self._make(particles, listed, stale)
        return self.pairs

    def _make(self, particles: Particles, listed: Particles | None, stale: Tensor) -> None:
        place = particles.position
        if listed is not None and not bool(stale.all()):
            place = torch.where(stale[particles.member][:, None], place, listed.position)
        self.pairs = self.backend.search(place, particles.member, self.radius, margin=self.margin, period=self.period)
        self.made_for = particles.changed(position=place)
        self.searches += 1
        self.renewed = stale.long() if self.renewed is None else self.renewed + stale

    def _listed(self, particles: Particles) -> Particles | None:
        """The particles of the present list in the rows of ``particles``; those of members that changed in number lie
        nowhere.  None: there is no list."""
        made = self.made_for
        if made is None or made.member is particles.member:
            return made
        if made.count == particles.count and torch.equal(made.member, particles.member):
            return made
        old, new = same_rows(made, particles)
        place = torch.full_like(particles.position, torch.inf)
        place[new] = made.position[old]
        return particles.changed(position=place)

    def _stale(self, particles: Particles, listed: Particles | None) -> Tensor:
        if listed is None or self.margin <= 0:
            return torch.ones(particles.members, dtype=torch.bool, device=particles.position.device)
        moved = particles.per_member(square_length(particles.position - listed.position), "amax")
        return ~(moved < (0.5 * self.margin) ** 2)

    def forget(self) -> None:
        """The particles were renumbered: the next call searches anew."""
        self.made_for = None

    def spatial_order(self, particles: Particles) -> Tensor | None:
        """Order (N,) in which the backend works through the particles; None where it has none."""
        return self.backend.order(self.at(particles))


def same_rows(before: Particles, after: Particles) -> tuple[Tensor, Tensor]:
    """Rows (n,) of ``before`` and of ``after`` that hold the same places in the members that kept their number.

    The particles of a member are told apart by their order alone.
    """
    old, new = (torch.argsort(p.member, stable=True) for p in (before, after))
    counts = [torch.bincount(p.member, minlength=after.members) for p in (before, after)]
    kept = counts[0] == counts[1]
    return old[kept[before.member[old]]], new[kept[after.member[new]]]


def rows_carried(before: Particles, after: Particles, values: Tensor) -> Tensor:
    """Values (N, D) of ``before`` in the rows of ``after``; zeros in members whose particles are not the same.

    Values that do not belong to ``before``, which somebody has put in the place of others, are zeros for all.
    """
    if len(values) != before.count:
        return torch.zeros_like(after.position)
    if before is after or before.position is after.position:
        return values
    old, new = same_rows(before, after)
    moved = (before.position[old] != after.position[new]).any(1)
    changed = torch.zeros(after.members, dtype=torch.bool, device=moved.device)
    changed[after.member[new[moved]]] = True
    same = ~changed[after.member[new]]
    out = torch.zeros_like(after.position)
    out[new[same]] = values[old[same]]
    return out
