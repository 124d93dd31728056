"""What XSPH pulls a particle's velocity towards: the full sum over neighbours, or the centroids of cells."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from torchsph.pairs.centroid import centroid_xsph
from torchsph.pairs.interface import RateTerms, Support

from ..state.neighbour_list import PairSearch
from ..state.particles import Particles


def neighbour_pull(
    particles: Particles, plain: Tensor | None, support: Support, search: PairSearch, centroid: bool
) -> Tensor:
    """XSPH's sum (N, D) before epsilon (2.33), internal units.

    A confidence multiplies the mass of a neighbour (thesis 5.2: "the correlation could be encoded in the mass").

    Args:
        plain: the full sum without confidences, where it was taken along with others. centroid: whether the sum goes
            over the centroids of cells instead (thesis 5.2).
    """
    if not centroid and particles.confidence is None:
        return plain
    state = particles.state(particles.deviation)
    if particles.confidence is not None:
        state = replace(state, mass=state.mass * particles.confidence)
    if centroid:
        # 1.5 cells reach as far as the kernel, so that adjacent cells hold all of it
        return centroid_xsph(state, support, support.radius / 1.5, search.period)
    return search.backend.rates(search.at(particles), state, support, RateTerms(None, xsph=True)).xsph
