"""Hybrid gain: an ensemble filter's perturbations around a mean that a second analysis shares in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..observations import Observations, Reason, Screened
from .base import Analysis, Filter


@dataclass(frozen=True, kw_only=True)
class HybridGain:
    """`mean = (1 - weight) ensemble analysis + weight second analysis` (Penny 2014, Mon. Wea. Rev. 142,
    3094).

    The ensemble knows the flow's errors of the day but few directions; a variational analysis (splines with
    divergence and wall rows, say) knows all directions but one day like another. Each corrects what the other
    cannot see. Members keep the filter's perturbations, so `Analysis.variance` is the filter's.

    Attributes:
        filter: any `Filter`.
        second: `(mean (*batch, n), observations) -> (*batch, n)`; it meets observations that the filter
            rejected with their `reason` set.
        weight: of the second analysis, in [0, 1].
        sequential: start the second analysis from the filter's mean (as in Penny 2014) instead of the
            forecast's.
    """

    filter: Filter
    second: Callable[[Tensor, Observations], Tensor]
    weight: float = 0.5
    sequential: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1:
            raise AssimilationError(f"HybridGain.weight must lie in [0, 1], got {self.weight}")

    def analyse(
        self,
        ensemble: Tensor,
        predicted: Tensor,
        observations: Observations,
        *,
        state_positions: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Analysis:
        """See `Filter.analyse`."""
        analysis = self.filter.analyse(
            ensemble, predicted, observations, state_positions=state_positions, generator=generator
        )
        start = analysis.mean if self.sequential else ensemble.double().mean(-2).to(ensemble.dtype)
        # Out of reach of the ensemble's localisation is not out of reach of the second analysis.
        reason = torch.where(analysis.reason == Reason.OUT_OF_REACH, 0, analysis.reason).to(torch.uint8)
        second = self.second(start, replace(observations, reason=reason))
        if second.shape != analysis.mean.shape or not bool(torch.isfinite(second).all()):
            raise AssimilationError(
                f"the second analysis must be finite and of shape {tuple(analysis.mean.shape)}, "
                f"got {tuple(second.shape)}"
            )
        shift = self.weight * (second.double() - analysis.mean.double())
        return replace(
            analysis,
            ensemble=(analysis.ensemble.double() + shift.unsqueeze(-2)).to(ensemble.dtype),
            mean=(analysis.mean.double() + shift).to(ensemble.dtype),
        )

    def screen(self, ensemble: Tensor, predicted: Tensor, observations: Observations) -> Screened:
        """See `Filter.screen`."""
        return self.filter.screen(ensemble, predicted, observations)
