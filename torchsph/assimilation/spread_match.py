"""How large the ensemble's spread has to be, from what an estimator finds in the innovations and in the ensemble."""

from __future__ import annotations

from .errors import AssimilationError


class SpreadMatch:
    """A factor on each forecast's anomalies that leads them to the variance that the forecast's errors show.

    Let A be any linear estimator of a field from the observations (a spline, say), x = A d what it makes of the
    innovations and g its best weight (``LearnedGain``). Then `g (Hx)' Hx` is on average `(HA e)' e` for the forecast's
    error e as it is observed: the observation errors have dropped out. The same number for the ensemble is
    `(HA a)' a` with an anomaly a as it is observed, so that what A fails to resolve cancels in their ratio. The
    anomalies carry the factors of earlier cycles, so each cycle's factor closes a share 1 / `memory` of the gap (in
    logarithms) and no more: accumulating factors would make the spread swing.

    It remembers: `state` and `restore` belong in a checkpoint.
    """

    def __init__(self, *, memory: float = 1.0, most: float = 4.0) -> None:
        """`most`: the largest ratio of variances that one cycle is believed to show."""
        if not memory >= 1 or not most > 1:
            raise AssimilationError(f"SpreadMatch needs memory >= 1 and most > 1, got {memory} and {most}")
        self.memory, self.most, self.factor = memory, most, 1.0

    def state(self) -> dict[str, float]:
        return {"factor": self.factor}

    def restore(self, state: dict[str, float]) -> None:
        self.factor = state["factor"]

    def learn(self, shown: float, own: float) -> None:
        """From one cycle: the number of the innovations, and that of the ensemble with the factor applied."""
        if own > 0:
            ratio = min(max(shown / own, 1.0 / self.most), self.most)
            self.factor = ratio ** (0.5 / self.memory)
