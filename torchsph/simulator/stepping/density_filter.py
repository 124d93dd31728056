"""Filters that smooth the density of a weakly compressible fluid every so many steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsph.pairs.interface import Rates, RateTerms
from torchsph.pairs.moving_least_squares import solve_small

from ..schemes.weakly_compressible import WeaklyCompressible
from ..state.particles import Particles
from ..state.required import required


def shepard_deviation(sums: Rates) -> Tensor:
    """Density deviation (N,) after Shepard's filter (Grønli 2017, eq. 2.20)."""
    return required(sums.shepard_mass, "Shepard's sum") / required(sums.shepard_volume, "Shepard's sum") - 1.0


def mls_deviation(sums: Rates) -> Tensor:
    """Density deviation (N,) of moving least squares (Colagrossi & Landrini 2003, eqs. 12-14; Dilts 1999).

    Exact for a linear density; where the neighbours lie in a line or plane, Shepard's value.
    """
    first = required(sums.moment_first, "the moments' sum")
    tilt = -solve_small(required(sums.moment_second, "the moments' sum"), first[:, :, None])[:, :, 0]
    volume = required(sums.shepard_volume, "Shepard's sum") + (tilt * first).sum(1)
    mass = required(sums.moment_mass, "the moments' sum")
    return (required(sums.shepard_mass, "Shepard's sum") + (tilt * mass).sum(1)) / volume - 1.0


@dataclass(frozen=True)
class DensityFilter:
    """A filter of the density.

    Attributes:
        period: steps from one filtering to the next.
        linear: whether a linear density is left alone (moving least squares), or Shepard's filter is taken.
    """

    period: int
    linear: bool

    @classmethod
    def of(cls, scheme: WeaklyCompressible) -> DensityFilter | None:
        """The filter of a scheme, or None where it has none."""
        return None if scheme.shepard_period is None else cls(scheme.shepard_period, scheme.density_filter == "mls")

    def due(self, number: Tensor, step: Tensor) -> Tensor | None:
        """Members whose density is filtered in their present step.

        Args:
            number: (members,) int64, of the step in the run.
            step: (members,), internal; 0 for members that wait.

        Returns:
            (members,) bool, or None where it is no member's.
        """
        due = (number % self.period == 0) & (step > 0)
        return due if bool(due.any()) else None

    def terms(self, terms: RateTerms) -> RateTerms:
        """With the sums that the filter needs."""
        return replace(terms, shepard=True, moments=self.linear)

    def apply(self, particles: Particles, sums: Rates, due: Tensor) -> Particles:
        """Particles with the density filtered in the members where ``due`` (members,) bool."""
        smooth = mls_deviation(sums) if self.linear else shepard_deviation(sums)
        return particles.changed(deviation=torch.where(due[particles.member], smooth, particles.deviation))
