"""Inflation: what keeps an ensemble from believing itself too much.

Convention: every factor here multiplies ANOMALIES (standard deviations), as in DAPPER. DART states the factor
of the variance (the square of ours), PDAF the forgetting factor (one over that square).

No inflation acts on state variables that no observation reaches (unless asked: `everywhere`): there nothing
takes spread away, so inflating would let it grow without bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..observations import Screened


class Inflation(Protocol):
    """Two hooks around an analysis; a method uses one of them and leaves the other neutral."""

    def prior_factor(self, screened: Screened) -> Tensor | float:
        """Factor, scalar or `(*batch,)`, of the forecast's anomalies before the analysis."""

    def relax(self, prior: Tensor, posterior: Tensor, reached: Tensor | None) -> Tensor:
        """Analysed anomalies `(*batch, N, n)` from the forecast's and the analysed ones."""


@dataclass(frozen=True)
class Multiplicative:
    """Analysed anomalies times a constant `factor` (>= 1 in practice)."""

    factor: float
    everywhere: bool = False

    def __post_init__(self) -> None:
        if not self.factor > 0:
            raise AssimilationError(f"Multiplicative.factor must be positive, got {self.factor}")

    def prior_factor(self, screened: Screened) -> float:
        """See `Inflation.prior_factor`."""
        return 1.0

    def relax(self, prior: Tensor, posterior: Tensor, reached: Tensor | None) -> Tensor:
        """See `Inflation.relax`."""
        inflated = posterior * self.factor
        return inflated if reached is None or self.everywhere else torch.where(reached, inflated, posterior)


@dataclass(frozen=True)
class RTPS:
    """Relaxation to prior spread (Whitaker & Hamill 2012, Mon. Wea. Rev. 140, eq. 2).

    Each state variable's spread is brought back to `(1 - alpha) analysed + alpha forecast`. `largest` bounds
    the factor where the analysed spread is next to nothing.
    """

    alpha: float
    largest: float = 10.0

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1 or not self.largest >= 1:
            raise AssimilationError(f"RTPS needs 0 <= alpha <= 1 and largest >= 1, got {self}")

    def prior_factor(self, screened: Screened) -> float:
        """See `Inflation.prior_factor`."""
        return 1.0

    def relax(self, prior: Tensor, posterior: Tensor, reached: Tensor | None) -> Tensor:
        """See `Inflation.relax`."""
        before, after = prior.std(-2, keepdim=True), posterior.std(-2, keepdim=True)
        tiny = torch.finfo(after.dtype).tiny
        factor = 1 + self.alpha * (before - after) / after.clamp(min=tiny)
        return posterior * factor.clamp(max=self.largest)


@dataclass(frozen=True)
class RTPP:
    """Relaxation to prior perturbations (Zhang, Snyder & Sun 2004, Mon. Wea. Rev. 132, eq. 5)."""

    alpha: float

    def __post_init__(self) -> None:
        if not 0 <= self.alpha <= 1:
            raise AssimilationError(f"RTPP needs 0 <= alpha <= 1, got {self.alpha}")

    def prior_factor(self, screened: Screened) -> float:
        """See `Inflation.prior_factor`."""
        return 1.0

    def relax(self, prior: Tensor, posterior: Tensor, reached: Tensor | None) -> Tensor:
        """See `Inflation.relax`."""
        return (1 - self.alpha) * posterior + self.alpha * prior


class Adaptive:
    """One factor for the forecast's spread, estimated from the innovations and filtered in time.

    With p the predicted and r the error variance of the used observations, `E d^2 = lambda^2 p + r` gives

        lambda^2_o = sum((d^2 - r) / r) / sum(p / r)        (Li, Kalnay & Miyoshi 2009, QJRMS 135, 523)

    with sampling variance `v_o = 2/m (lambda^2 + sum(1) / sum(p / r))^2` for m independent observations
    (Miyoshi 2011, Mon. Wea. Rev. 139, 1519), entered into a scalar Kalman filter whose own uncertainty
    grows by `drift` a cycle. Errors that are correlated count for less (`Observations.redundancy`).

    It remembers: `state()` and `restore()` belong into a checkpoint. `smallest` and `largest` bound it.
    """

    def __init__(self, *, start: float = 1.0, drift: float = 0.03, smallest: float = 1.0, largest: float = 3.0) -> None:
        if not (drift > 0 and 0 < smallest <= start <= largest):
            raise AssimilationError("Adaptive needs drift > 0 and 0 < smallest <= start <= largest")
        self.drift, self.smallest, self.largest = drift, smallest, largest
        self._square: Tensor = torch.tensor(start**2, dtype=torch.float64)
        self._variance: Tensor = torch.tensor(drift**2, dtype=torch.float64)

    def state(self) -> dict[str, Tensor]:
        """Squared factor and its variance, scalar or `(*batch,)`."""
        return {"square": self._square.clone(), "variance": self._variance.clone()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` gave."""
        self._square, self._variance = state["square"].clone(), state["variance"].clone()

    def prior_factor(self, screened: Screened) -> Tensor:
        """See `Inflation.prior_factor`."""
        used = screened.used
        ratio = torch.where(used, screened.predicted_variance / screened.variance, 0.0).sum(-1)
        excess = torch.where(used, screened.innovation**2 / screened.variance - 1, 0.0).sum(-1)
        count = (screened.weight * screened.variance).nan_to_num(0.0).sum(-1)  # sum of 1 / redundancy
        informed = (ratio > 0) & (count > 0)
        # Where nothing is observed, or the ensemble has collapsed, the estimate stays as it was.
        ratio = torch.where(informed, ratio, 1.0)
        self._square = self._square.to(ratio.device).expand(ratio.shape)
        spread = (self._variance.to(ratio.device) + self.drift**2).expand(ratio.shape)
        sampling = 2 / count.clamp(min=1e-30) * (self._square + used.sum(-1) / ratio) ** 2
        gain = torch.where(informed, spread / (spread + sampling), 0.0)
        # One cycle's estimate may be anything, negative too: clipping it would bias the mean upwards.
        square = self._square + gain * (excess / ratio - self._square)
        self._square = square.clamp(self.smallest**2, self.largest**2)
        self._variance = torch.where(informed, (1 - gain) * spread, self._variance.to(ratio.device))
        return self._square.sqrt()

    def relax(self, prior: Tensor, posterior: Tensor, reached: Tensor | None) -> Tensor:
        """See `Inflation.relax`."""
        return posterior
