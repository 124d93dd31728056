"""The neighbours of a run's particles: found anew only where the particles have moved too far for the old list."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchsph.pairs.interface import Backend
from torchsph.pairs.vectors import square_length

from .particles import Particles


@dataclass
class PairSearch:
    """The neighbour list and where the particles were when it was made."""

    backend: Backend
    radius: float
    margin: float
    period: Tensor | None = None
    pairs: Any = None
    made_at: Tensor | None = None
    searches: int = 0

    def stale(self, particles: Particles) -> bool:
        """Whether the particles have moved, or changed in number, beyond what the list allows for."""
        if self.made_at is None or self.made_at.shape != particles.position.shape:
            return True
        if particles.count == 0:
            return False
        moved = square_length(particles.position - self.made_at).amax().item()
        return not moved < (0.5 * self.margin) ** 2

    def at(self, particles: Particles) -> Any:
        """Pairs that are valid at the particles' present positions."""
        if self.stale(particles):
            self.pairs = self.backend.search(
                particles.position, particles.member, self.radius, margin=self.margin, period=self.period
            )
            self.made_at = particles.position
            self.searches += 1
        return self.pairs

    def forget(self) -> None:
        """The particles were renumbered: the next call searches anew."""
        self.made_at = None

    def spatial_order(self, particles: Particles) -> Tensor | None:
        """Order (N,) in which the backend works through the particles; None where it has none."""
        return self.backend.order(self.at(particles))
