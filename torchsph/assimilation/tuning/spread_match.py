"""How large the ensemble's spread has to be, from what an estimator finds in the innovations and in the ensemble."""

from __future__ import annotations

from ..errors import AssimilationError

# share of the forecast's error variance that an analysis leaves at least
_LEAST_LEFT = 0.25


class SpreadMatch:
    """Factors that lead the anomalies of forecasts and analyses to the variances that their errors show.

    Forecasts. Let A be any linear estimator of a field from the observations (a spline, say), x = A d what it makes of
    the innovations and g its best weight (``LearnedGain``). Then `g (Hx)' Hx` is on average `(HA e)' e` for the
    forecast's error e as it is observed: the observation errors have dropped out. The same number for the ensemble is
    `(HA a)' a` with an anomaly a as it is observed, so that what A fails to resolve cancels in their ratio. A cycle
    closes a share 1 / `memory` of the gap (in logarithms) at once, in its own analysis (``now``), and a share
    1 / `lasting` in the forecasts to come (``factor``), whose perturbations are too large or too small again each time.

    Analyses. With that weight the increment is, on average, orthogonal to the error that is left, so the error's
    variance falls by the increment's own (Pythagoras) and by no more. A filter's transform takes more: the analysed
    members lose as much of what the measurement cannot see as of what it sees (``left``).

    It remembers: `state` and `restore` belong in a checkpoint.
    """

    def __init__(self, *, memory: float = 2.0, lasting: float = 6.0, averaged: float = 8.0, most: float = 4.0) -> None:
        """`averaged`: cycles whose increments and variances tell what an analysis leaves. `most`: the largest ratio of
        variances that one cycle is believed to show, and the largest factor."""
        if not min(memory, lasting, averaged) >= 1 or not most > 1:
            raise AssimilationError(
                "SpreadMatch needs memory, lasting and averaged >= 1 and most > 1, "
                f"got {memory}, {lasting}, {averaged} and {most}"
            )
        self.memory, self.lasting, self.averaged, self.most = memory, lasting, averaged, most
        self.factor, self.now, self.cycles = 1.0, 1.0, 0
        self._taken, self._before = 0.0, 0.0

    def state(self) -> dict[str, float]:
        return {
            "factor": self.factor,
            "now": self.now,
            "cycles": self.cycles,
            "taken": self._taken,
            "before": self._before,
        }

    def restore(self, state: dict[str, float]) -> None:
        self.factor, self.now, self.cycles = state["factor"], state["now"], int(state["cycles"])
        self._taken, self._before = state["taken"], state["before"]

    def learn(self, shown: float, own: float) -> None:
        """From one cycle: the number of the innovations, and that of the ensemble with the factor applied."""
        self.now = 1.0
        if own > 0:
            ratio = min(max(shown / own, 1.0 / self.most), self.most)
            self.cycles += 1
            self.now = ratio ** (0.5 / min(self.memory, self.cycles))
            if self.cycles > 1:  # what the first one shows is the start's
                self.factor = min(max(self.factor * ratio ** (0.5 / self.lasting), 1.0 / self.most), self.most)

    def left(self, before: float, after: float, taken: float) -> float:
        """Factor on the analysed anomalies that leaves them the variance of what is left of the error.

        Args:
            before, after: sums over the state of the ensemble's variance, in the forecast and as the filter leaves it.
            taken: sum over the state of the squared increment.
        """
        before *= self.now**2
        kept = 1.0 - 1.0 / self.averaged
        self._taken, self._before = kept * self._taken + taken, kept * self._before + before
        if not after > 0 or not self._before > 0:
            return 1.0
        return (before * max(1.0 - self._taken / self._before, _LEAST_LEFT) / after) ** 0.5
