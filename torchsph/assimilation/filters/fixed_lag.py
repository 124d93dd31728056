"""Fixed-lag ensemble smoother around any filter of this package."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..observations import Observations
from .base import Analysis, Filter


class FixedLagSmoother:
    """Later observations applied to the states of the last `lag` cycles (`Analysis.carried_back`).

    Feed it exactly like the filter.
    """

    def __init__(self, filter_: Filter, lag: int) -> None:
        if lag < 1:
            raise AssimilationError(f"the smoother's lag must be at least 1 cycle, got {lag}")
        self.filter, self.lag = filter_, lag
        self._states: deque[Tensor] = deque()

    def analyse(
        self,
        ensemble: Tensor,
        predicted: Tensor,
        observations: Observations,
        *,
        state_positions: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> tuple[Analysis, Tensor | None]:
        """The analysis, and the smoothed ensemble of `lag` cycles ago (None in the first `lag` cycles)."""
        analysis = self.filter.analyse(
            ensemble, predicted, observations, state_positions=state_positions, generator=generator
        )
        self._states = deque(analysis.carried_back(state) for state in self._states)
        self._states.append(analysis.ensemble)
        finished = self._states.popleft() if len(self._states) > self.lag else None
        return analysis, finished

    def flush(self) -> list[Tensor]:
        """The ensembles still held, oldest first, knowing all observations so far; empties the smoother."""
        states = list(self._states)
        self._states.clear()
        return states

    def state(self) -> list[Tensor]:
        """What a checkpoint has to hold, oldest first."""
        return [state.clone() for state in self._states]

    def restore(self, states: list[Tensor]) -> None:
        self._states = deque(state.clone() for state in states)
