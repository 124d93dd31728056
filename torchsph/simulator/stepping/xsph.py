"""XSPH's sum of velocity differences: over all neighbours, or over the centroids of cells."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from torchsph.pairs.centroid import centroid_xsph
from torchsph.pairs.interface import RateTerms, Support

from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..state.required import required


def xsph_sum(
    particles: Particles, plain: Tensor | None, support: Support, search: PairSearch, centroid: bool
) -> Tensor:
    """XSPH's sum before its factor epsilon (Grønli 2017, eq. 2.33).

    A confidence multiplies the mass of a neighbour (Grønli 2017, sec. 5.2: "the correlation could be encoded in the
    mass").

    Args:
        particles: whose velocities are compared.
        plain: (N, D), the full sum without confidences, where it was taken along with others, or None.
        support: kernel and smoothing length.
        search: neighbour list.
        centroid: whether the sum goes over the centroids of cells instead (Grønli 2017, sec. 5.2).

    Returns:
        (N, D), internal.
    """
    if not centroid and particles.confidence is None:
        return required(plain, "XSPH's sum")
    state = particles.state(particles.deviation)
    if particles.confidence is not None:
        state = replace(state, mass=state.mass * particles.confidence)
    if centroid:
        # 1.5 cells reach as far as the kernel, so that adjacent cells hold all of it
        return centroid_xsph(state, support, support.radius / 1.5, search.period)
    sums = search.backend.rates(search.at(particles), state, support, RateTerms(None, xsph=True))
    return required(sums.xsph, "XSPH's sum")
