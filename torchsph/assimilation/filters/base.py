"""What an ensemble filter is: the protocol, what it returns, and the frame that all of them share.

An ensemble is a tensor `(*batch, N, n)`: N members of a state of n numbers; `predicted (*batch, N, m)` is the
observation operator applied to each member, by whoever owns it. A filter therefore knows nothing of models.
Leading batch dimensions are independent experiments that share one call.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..observations import Observations, Screened, count_reasons, screen
from .inflation import Inflation
from .rotation import need_generator, random_rotation


@dataclass(frozen=True)
class Analysis:
    """The analysed ensemble and what the analysis tells about itself.

    Attributes:
        ensemble: `(*batch, N, n)`, dtype of the forecast.
        mean: `(*batch, n)`, the estimate; for most filters the members' average.
        variance: `(*batch, n)`, the error variance of `mean` that the filter claims.
        reason: `(*batch, m)` uint8 `Reason` codes, 0 = used.
        innovation: `(*batch, m)` float64, observation minus mean prediction; NaN where there is none.
        innovation_variance: `(*batch, m)` float64, what the innovation's variance should be: predicted
            variance (after prior inflation) plus bare error variance.
        signal: `(*batch,)` degrees of freedom that the observations determined (of at most N - 1); for
            local analyses the mean over those that had observations.
        prior_factor: factor on the forecast's spread that was used, scalar or `(*batch,)`.
        spread_before, spread_after: `(*batch,)` root mean variance over the state.
        transform: the linear map of members that was applied; a smoother applies it to earlier states. None where
            it was left behind.
        rotation: `(*batch, N, N)` applied to the anomalies after it, or None.
        warnings: in words, empty when all is well.
    """

    ensemble: Tensor
    mean: Tensor
    variance: Tensor
    reason: Tensor
    innovation: Tensor
    innovation_variance: Tensor
    signal: Tensor
    prior_factor: Tensor | float
    spread_before: Tensor
    spread_after: Tensor
    transform: Transform | None
    rotation: Tensor | None = None
    warnings: tuple[str, ...] = field(default=())

    def counts(self) -> dict[str, int]:
        """Number of observations per `Reason`, those used among them."""
        return count_reasons(self.reason)

    def normalised_innovation(self) -> Tensor:
        """`(*batch, m)`: innovation over its expected standard deviation; about N(0, 1) if all is well."""
        return self.innovation / self.innovation_variance.sqrt()

    def carried_back(self, earlier: Tensor) -> Tensor:
        """An ensemble of an earlier time as this analysis improves it: an ensemble smoother.

        The analysis is a linear map of members, and the same map improves the states that those members came from: no
        backward pass, no model (Evensen & van Leeuwen 2000, Mon. Wea. Rev. 128, 1852; Cohn et al. 1994). Inflation is
        not applied to earlier states; a rotation is, so that members stay matched.

        Args:
            earlier: `(*batch, N, n)` the states that the members came from.

        Raises:
            AssimilationError: the analysis has left its transform behind.
        """
        if self.transform is None:
            raise AssimilationError("this analysis has left its transform behind: earlier states cannot follow it")
        moved, reached = self.transform.apply(earlier), self.transform.reached
        if reached is not None:
            moved = torch.where(reached, moved, earlier)
        if self.rotation is None:
            return moved
        wide = moved.double()
        mean = wide.mean(-2, keepdim=True)
        return (mean + self.rotation @ (wide - mean)).to(earlier.dtype)


class Filter(Protocol):
    """Anything that turns a forecast ensemble and observations into an analysed ensemble."""

    def analyse(
        self,
        ensemble: Tensor,
        predicted: Tensor,
        observations: Observations,
        *,
        state_positions: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Analysis:
        """Args:
        ensemble: `(*batch, N, n)` forecast.
        predicted: `(*batch, N, m)` predicted observations; NaN where a member has none.
        observations: of the same m.
        state_positions: `(q, D)`, n a multiple of q, number k at position k % q (component-major fields);
            needed by localised filters only. A NaN row is a number without a place (a parameter).
        generator: needed by filters that draw random numbers.
        """

    def screen(self, ensemble: Tensor, predicted: Tensor, observations: Observations) -> Screened:
        """What `analyse` will use of the observations, for whoever works on the innovations at the same time."""


class Transform(Protocol):
    """A linear map of members; `reached`, broadcastable to `(*batch, N, n)`, marks what it may change."""

    @property
    def reached(self) -> Tensor | None: ...

    def apply(self, ensemble: Tensor) -> Tensor:
        """`(*batch, N, n)` -> analysed `(*batch, N, n)`, dtype kept, before inflation and rotation."""


@dataclass(frozen=True)
class GlobalTransform:
    """Every number of the state is mapped alike: analysed member j is `sum_i matrix[i, j] member i`.

    `matrix (*batch, N, N)` has columns that sum to one, so a state may be spread over processes by members:
    `contribution` of each process's members, summed over processes, is the analysis.
    """

    matrix: Tensor
    reached: Tensor | None = None

    def apply(self, ensemble: Tensor) -> Tensor:
        mean = ensemble.double().mean(-2, keepdim=True)
        # On anomalies: members that share a large mean lose no digits.
        return (mean + self.matrix.mT @ (ensemble.double() - mean)).to(ensemble.dtype)

    def contribution(self, members: Tensor, rows: slice) -> Tensor:
        """What the members number `rows`, `(*batch, k, n)`, add to all N analysed members; float64."""
        return self.matrix[..., rows, :].mT @ members.double()


@dataclass(frozen=True)
class Target:
    """The state that an analysis is for: n numbers, their positions `(q, D)` if known, their precision."""

    size: int
    positions: Tensor | None
    dtype: torch.dtype


@dataclass(frozen=True, kw_only=True)
class EnsembleFilter(ABC):
    """Screening, inflation, rotation and record keeping around a method's `_transform`.

    Attributes:
        inflation: one method, several (used in turn), or None.
        rotation: mix the analysed members at random, keeping mean and covariance (needs a generator).
        gross_error: reject innovations beyond so many standard deviations; None accepts all.
    """

    inflation: Inflation | tuple[Inflation, ...] | None = None
    rotation: bool = False
    gross_error: float | None = None

    def __post_init__(self) -> None:
        if self.gross_error is not None and not self.gross_error > 0:
            raise AssimilationError(f"gross_error must be positive or None, got {self.gross_error}")

    @abstractmethod
    def _transform(
        self,
        anomalies: Tensor,
        screened: Screened,
        observations: Observations,
        target: Target,
        generator: torch.Generator | None,
    ) -> tuple[Transform, Tensor, Tensor]:
        """The map, the signal's degrees of freedom and the reason codes.

        Args:
            anomalies: `(*batch, N, m)` predicted observations less their mean, zero where not used.
            target: what the map will be applied to.
        """

    def analyse(
        self,
        ensemble: Tensor,
        predicted: Tensor,
        observations: Observations,
        *,
        state_positions: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Analysis:
        """See `Filter.analyse`. Raises `AssimilationError` on shapes that do not fit and on NaN members."""
        check_ensemble(ensemble, predicted, observations)
        wide = predicted.double()
        mean = self._mean(wide)
        screened = self._screened(wide, observations)
        factor = torch.as_tensor(1.0, dtype=torch.float64)
        for part in self._inflations():
            factor = factor * part.prior_factor(screened)
        anomalies = (wide - mean.unsqueeze(-2)) * _column(factor, 2)
        anomalies = torch.where(screened.used.unsqueeze(-2), anomalies, 0.0)
        target = Target(ensemble.shape[-1], state_positions, ensemble.dtype)
        transform, signal, reason = self._transform(anomalies, screened, observations, target, generator)
        rotation = self._rotation(ensemble, generator)
        analysed = self._finish(ensemble, factor, transform, rotation)
        variance = self._variance(analysed)
        before, after = self._variance(ensemble.double()).mean(-1).sqrt(), variance.mean(-1).sqrt()
        return Analysis(
            ensemble=analysed.to(ensemble.dtype),
            mean=self._mean(analysed).to(ensemble.dtype),
            variance=variance.to(ensemble.dtype),
            reason=reason,
            innovation=(observations.value.double() - mean),
            innovation_variance=screened.predicted_variance * _column(factor, 1) ** 2 + screened.variance,
            signal=signal,
            prior_factor=factor,
            spread_before=before,
            spread_after=after,
            transform=transform,
            rotation=rotation,
            warnings=_warnings(ensemble, before, reason),
        )

    def screen(self, ensemble: Tensor, predicted: Tensor, observations: Observations) -> Screened:
        """See `Filter.screen`."""
        check_ensemble(ensemble, predicted, observations)
        return self._screened(predicted.double(), observations)

    def _screened(self, predicted: Tensor, observations: Observations) -> Screened:
        mean, variance = self._mean(predicted), self._variance(predicted)
        return screen(observations, mean, variance, self.gross_error)

    def _mean(self, points: Tensor) -> Tensor:
        """`(*batch, k)` estimate from members `(*batch, N, k)`; equal weights unless a method says
        otherwise.
        """
        return points.mean(-2)

    def _variance(self, points: Tensor) -> Tensor:
        """`(*batch, k)` error variance from members `(*batch, N, k)`, divisor N - 1."""
        anomalies = points - points.mean(-2, keepdim=True)
        return anomalies.square().sum(-2) / (points.shape[-2] - 1)

    def _inflations(self) -> tuple[Inflation, ...]:
        if self.inflation is None:
            return ()
        return self.inflation if isinstance(self.inflation, tuple) else (self.inflation,)

    def _rotation(self, ensemble: Tensor, generator: torch.Generator | None) -> Tensor | None:
        if not self.rotation:
            return None
        draw = need_generator(generator, "rotation")
        batch = tuple(ensemble.shape[:-2])
        return random_rotation(ensemble.shape[-2], draw, batch=batch, device=ensemble.device)

    def _finish(self, ensemble: Tensor, factor: Tensor, transform: Transform, rotation: Tensor | None) -> Tensor:
        """Prior inflation, transform, posterior inflation and rotation of the state, float64."""
        wide = ensemble.double()
        mean = self._mean(wide).unsqueeze(-2)
        prior = wide - mean
        analysed = transform.apply((mean + prior * _column(factor, 2)).to(ensemble.dtype)).double()
        if transform.reached is not None:
            analysed = torch.where(transform.reached, analysed, wide)
        mean = self._mean(analysed).unsqueeze(-2)
        posterior = analysed - mean
        for part in self._inflations():
            posterior = part.relax(prior, posterior, transform.reached)
        return mean + (posterior if rotation is None else rotation @ posterior)


def check_ensemble(ensemble: Tensor, predicted: Tensor, observations: Observations) -> None:
    """Raise `AssimilationError` where the three do not belong together or a member is not finite."""
    if ensemble.ndim < 2 or ensemble.shape[-2] < 2:
        raise AssimilationError(f"an ensemble is (members >= 2, state), got {tuple(ensemble.shape)}")
    if predicted.shape[:-1] != ensemble.shape[:-1]:
        raise AssimilationError(
            f"predicted observations {tuple(predicted.shape)} must have the ensemble's batch and members, "
            f"{tuple(ensemble.shape[:-1])}"
        )
    if predicted.shape[-1] != len(observations):
        raise AssimilationError(f"{predicted.shape[-1]} predicted observations for {len(observations)} observations")
    bad = ~torch.isfinite(ensemble).all(-1)
    if bool(bad.any()):
        raise AssimilationError(
            f"members {torch.nonzero(bad).tolist()} are not finite: replace failed members "
            "(replace_failed) before the analysis"
        )


def _column(factor: Tensor, extra: int) -> Tensor:
    """A per-experiment factor, shaped to multiply tensors with `extra` more dimensions."""
    return factor.reshape(*factor.shape, *([1] * extra)) if factor.ndim else factor


def _warnings(ensemble: Tensor, spread: Tensor, reason: Tensor) -> tuple[str, ...]:
    words = []
    size = ensemble.double().square().mean((-2, -1)).sqrt()
    if bool((spread <= torch.finfo(ensemble.dtype).eps * size).any()):
        words.append("the ensemble has collapsed to one state: observations cannot change it")
    if reason.numel() and not bool((reason == 0).any()):
        words.append("no observation was used in this cycle: the analysis is the forecast")
    return tuple(words)
