"""The simulator's own pressure on a grid, averaged over the steps of a part of a run.

The pressure of a projection answers the divergence of one step, and its last digits the disorder of the particles: one
step's field is rough, and the average over the steps of a few milliseconds is not. Every step is fetched at the nodes
by the same moving least squares as velocities, and weighted with its length.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from geometry import Grid
from torchsph.pairs.interface import Backend
from torchsph.pairs.moving_least_squares import fetch_at

from ..state.particles import Particles
from ..state.units import Units
from .fetching import FETCH_RADIUS

__all__ = ["PressureAverages", "Stepping"]


class Stepping(Protocol):
    """What an average needs of a run."""

    particles: Particles
    units: Units

    @property
    def backend(self) -> Backend:
        """For the sums over neighbours."""

    @property
    def period(self) -> Tensor | None:
        """(D,), internal, of the periodic box, or None."""

    def pressure(self) -> Tensor:
        """(N,), Pa, of the particles as the last step left them."""


class PressureAverages:
    """Averages over spans of time of a run that calls ``note`` after every step (``AdvancingRun.observers``).

    Args:
        grid: the nodes, m.
        masks: (*shape) bool of each span, where the pressure is wanted.
        spans: (begin, end) of each, s; a step counts for the span that its middle lies in.
    """

    def __init__(self, grid: Grid, masks: Sequence[Tensor], spans: Sequence[tuple[float, float]]) -> None:
        self.grid, self.spans = grid, list(spans)
        self._nodes = [torch.nonzero(mask.reshape(-1)).squeeze(1) for mask in masks]
        self._sums: list[Tensor | None] = [None] * len(self.spans)
        self._weights: list[Tensor | None] = [None] * len(self.spans)

    def note(self, run: Stepping, time: Tensor, length: Tensor) -> None:
        """Count one step of each member, to ``time`` (members,), s, and of ``length`` (members,), s, 0 where none."""
        middle = time - 0.5 * length
        for number, (begin, end) in enumerate(self.spans):
            weight = torch.where((middle >= begin) & (middle < end), length, torch.zeros_like(length))
            if not bool((weight > 0).any()):
                continue
            value, covered = self._fetched(run, self._nodes[number])
            weight = weight.to(value)[:, None] * covered
            sums, weights = self._sums[number], self._weights[number]
            self._sums[number] = weight * value if sums is None else sums + weight * value
            self._weights[number] = weight if weights is None else weights + weight

    def fields(self, members: int) -> Tensor:
        """(members, spans, *shape), Pa; not a number where no particle has covered a node, or no step was taken."""
        out = torch.full((members, len(self.spans), self.grid.size), torch.nan)
        for number, (nodes, total, weight) in enumerate(zip(self._nodes, self._sums, self._weights, strict=True)):
            if total is not None and weight is not None:
                out[:, number, nodes] = (total / weight).to(out)  # 0 / 0 is not a number, as it should be
        return out.reshape(members, len(self.spans), *self.grid.shape)

    def _fetched(self, run: Stepping, nodes: Tensor) -> tuple[Tensor, Tensor]:
        """(members, nodes) Pa and whether particles cover them."""
        particles, members = run.particles, run.particles.members
        device = particles.position.device
        points = self.grid.nodes(dtype=torch.float64, device=device)[nodes.to(device)] / run.units.length
        found = fetch_at(
            run.backend,
            points.to(particles.position.dtype).repeat(members, 1),
            torch.arange(members, device=device).repeat_interleave(len(nodes)),
            particles.position,
            particles.member,
            run.pressure()[:, None],
            FETCH_RADIUS,
            period=run.period,
            weight=particles.inside.to(particles.mass),
        )
        return found.value[:, 0].reshape(members, -1).cpu(), found.covered.reshape(members, -1).cpu()
