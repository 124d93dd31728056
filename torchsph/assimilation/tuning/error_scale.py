"""How wrong the stated observation errors are, learned from the innovations."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ..diagnostics.scores import CHI2_MEDIAN
from ..errors import AssimilationError
from ..filters.base import Analysis
from ..observations import Observations, Reason


class ErrorScale:
    """A factor on the stated error variance of each group of observations (a source, a component).

    For an innovation d with predicted variance p and stated error variance r, `d^2 / (p + s r)` is chi^2
    distributed with the right s. Each cycle gives the s at which half of these ratios lie below chi^2's
    median: up to half of a group may be outliers, and observations that the gross-error check rejected are
    counted too, so that a filter told far too small errors finds its way back. Cycles are averaged with
    weight 1 / `memory`, the first `memory` of them equally.

    Spread and errors cannot be told apart from the innovations alone: with too little spread the errors are
    overestimated, the observations trusted less, and the error grows beyond the spread. Use it
    with an inflation that ties the spread to the forecast's (`RTPS`), not with a constant factor.

    It remembers: `state` and `restore` belong in a checkpoint.
    """

    def __init__(self, groups: int = 1, *, memory: float = 20.0, smallest: float = 0.01, largest: float = 1e4) -> None:
        if groups < 1 or not memory >= 1 or not 0 < smallest < largest:
            raise AssimilationError("ErrorScale needs groups >= 1, memory >= 1 and 0 < smallest < largest")
        self.memory, self.smallest, self.largest = memory, smallest, largest
        self._factor = torch.ones(groups, dtype=torch.float64)
        self._cycles = torch.zeros(groups, dtype=torch.float64)

    @property
    def factor(self) -> Tensor:
        """`(groups,)` present factors on the error variance."""
        return self._factor.clone()

    def state(self) -> dict[str, Tensor]:
        return {"factor": self._factor.clone(), "cycles": self._cycles.clone()}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._factor, self._cycles = state["factor"].clone(), state["cycles"].clone()

    def apply(self, observations: Observations, group: Tensor | int = 0) -> Observations:
        """With the variances multiplied; `group` is `(m,)` or one number for all."""
        factor = self.factor.to(observations.variance.device)[group]
        return replace(observations, variance=observations.variance * factor.to(observations.variance.dtype))

    def learn(self, analysis: Analysis, observations: Observations, group: Tensor | int = 0) -> None:
        """From an analysis of the observations that `apply` returned. Groups without data keep their
        factor.
        """
        counted = (analysis.reason == Reason.USED) | (analysis.reason == Reason.GROSS_ERROR)
        group = torch.as_tensor(group, device=counted.device).expand(counted.shape)
        present = observations.variance.double().expand(counted.shape)
        predicted = analysis.innovation_variance - present
        for number in range(len(self._factor)):
            mine = counted & (group == number)
            if not bool(mine.any()):
                continue
            stated = present[mine] / self._factor[number].item()
            found = self._median_match(analysis.innovation[mine].square(), predicted[mine], stated)
            self._cycles[number] += 1
            share = 1 / min(self.memory, self._cycles[number].item())
            self._factor[number] += share * (found - self._factor[number])

    def _median_match(self, square: Tensor, predicted: Tensor, stated: Tensor) -> float:
        """The factor at which half of the normalised squares lie below chi^2's median, by bisection."""
        low, high = math.log(self.smallest), math.log(self.largest)
        for _ in range(40):
            middle = 0.5 * (low + high)
            ratio = square / (predicted + math.exp(middle) * stated)
            if ratio.median().item() > CHI2_MEDIAN:
                low = middle
            else:
                high = middle
        return math.exp(0.5 * (low + high))
