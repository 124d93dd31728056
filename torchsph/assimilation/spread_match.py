"""How large the ensemble's spread has to be, from what an estimator finds in the innovations and in the ensemble."""

from __future__ import annotations

import math

from .errors import AssimilationError

# one cycle's ratio is noisy, and the factor acts on anomalies that carry the factors of the cycles before
_MOST = 4.0


class SpreadMatch:
    """One factor on the forecast's anomalies that gives them the variance that the forecast's errors show.

    Let A be any linear estimator of a field from the observations (a spline, say), x = A d what it makes of the
    innovations and g its best weight (``LearnedGain``). Then `g (Hx)' Hx` is on average `(HA e)' e` for the forecast's
    error e as it is observed: the observation errors have dropped out. The same number for the ensemble is
    `(HA a)' a` with an anomaly a as it is observed, so that what A fails to resolve cancels in their ratio, which the
    factor's square follows within `smallest` and `largest`: soon in the
    first cycles, slowly (`memory` cycles) later.

    It remembers: `state` and `restore` belong in a checkpoint.
    """

    def __init__(self, *, memory: float = 5.0, smallest: float = 0.5, largest: float = 3.0) -> None:
        if not memory >= 1 or not 0 < smallest <= 1 <= largest:
            raise AssimilationError("SpreadMatch needs memory >= 1 and 0 < smallest <= 1 <= largest")
        self.memory, self.smallest, self.largest = memory, smallest, largest
        self.factor, self._cycles = 1.0, 0

    def state(self) -> dict[str, float]:
        return {"factor": self.factor, "cycles": self._cycles}

    def restore(self, state: dict[str, float]) -> None:
        self.factor, self._cycles = state["factor"], state["cycles"]

    def learn(self, shown: float, own: float) -> None:
        """From one cycle: the number of the innovations, and that of the ensemble with the factor applied."""
        if own > 0:
            ratio = min(max(shown / own, 1.0 / _MOST), _MOST)
            self._cycles += 1
            self.factor *= math.exp(0.5 * math.log(ratio) / min(self.memory, 1.0 + self._cycles))
            self.factor = min(max(self.factor, self.smallest), self.largest)
