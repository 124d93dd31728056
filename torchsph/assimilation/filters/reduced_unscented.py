"""Reduced-order unscented Kalman filter: sigma points in an error subspace of rank r."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..observations import Observations, Screened
from .base import Analysis, EnsembleFilter, GlobalTransform, Target, Transform, check_ensemble
from .sigma import SigmaPoints, Simplex
from .subspace import update_weights


@dataclass(frozen=True, kw_only=True)
class ReducedUnscented(EnsembleFilter):
    """Moireau & Chapelle (2011), ESAIM: COCV 17, 380: r + 1 (simplex) or 2r + 1 (symmetric) members.

    The members ARE the sigma points: start them with `draw_points`, let the model move them, and each
    analysis returns the next set. Mean and error are those of the weighted points, `Analysis.mean` and
    `.variance`. The covariance is projected on the sigma directions (the paper's L = sum w x c'), which
    keeps the rank at r and moves every member as little as possible. For the simplex nothing is lost by it.
    For the symmetric set the even part of the model's response is; `keep_variance` scales the points so
    that their total variance is kept (all moves of the mean are of second order either way).

    On linear problems both are the Kalman filter, like the ETKF, whose divisor N - 1 is N here.
    """

    points: SigmaPoints = field(default_factory=Simplex)
    keep_variance: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rotation:
            raise AssimilationError("sigma points must keep their places: rotation=False")

    def analyse(
        self,
        ensemble: Tensor,
        predicted: Tensor,
        observations: Observations,
        *,
        state_positions: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Analysis:
        """See `Filter.analyse`; `ensemble` and `predicted` are sigma points in the order of the rule."""
        return super().analyse(
            *self._kept(ensemble, predicted, observations),
            observations,
            state_positions=state_positions,
            generator=generator,
        )

    def screen(self, ensemble: Tensor, predicted: Tensor, observations: Observations) -> Screened:
        """See `Filter.screen`."""
        return super().screen(*self._kept(ensemble, predicted, observations), observations)

    def _kept(self, ensemble: Tensor, predicted: Tensor, observations: Observations) -> tuple[Tensor, Tensor]:
        """States and predictions with the variance that the projection on sigma points takes from them."""
        check_ensemble(ensemble, predicted, observations)
        if not self.keep_variance:
            return ensemble, predicted
        factor = self._lost_variance(ensemble)
        return self._stretch(ensemble, factor), self._stretch(predicted, factor)

    def _rule(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weights `(N,)`, coordinates `(N, r)` and the projection `(r, N)` of points on their modes."""
        weight, coordinate = self.points.rule(self.points.rank(points.shape[-2]), points.device)
        return weight, coordinate, (weight.unsqueeze(-1) * coordinate).mT

    def _mean(self, points: Tensor) -> Tensor:
        return (self._rule(points)[0].unsqueeze(-1) * points).sum(-2)

    def _variance(self, points: Tensor) -> Tensor:
        return (self._rule(points)[2] @ points).square().sum(-2)

    def _lost_variance(self, ensemble: Tensor) -> Tensor:
        """`(*batch,)` factor that restores what the projection takes from the total variance; >= 1."""
        full = self.points.gather(ensemble).modes.square().sum((-2, -1))
        kept = self._variance(ensemble.double()).sum(-1)
        return torch.where(kept > 0, (full / kept.clamp(min=torch.finfo(full.dtype).tiny)).sqrt(), 1.0)

    def _stretch(self, points: Tensor, factor: Tensor) -> Tensor:
        """Odd part of the points times `factor`, their mean kept."""
        _, coordinate, project = self._rule(points)
        odd = coordinate @ (project @ points.double())
        return (points.double() + (factor[..., None, None] - 1) * odd).to(points.dtype)

    def _transform(
        self,
        anomalies: Tensor,
        screened: Screened,
        observations: Observations,
        target: Target,
        generator: torch.Generator | None,
    ) -> tuple[Transform, Tensor, Tensor]:
        weight, coordinate, project = self._rule(anomalies)
        modes = project @ anomalies
        weighted = modes * screened.weight.unsqueeze(-2)
        projected = (weighted @ screened.innovation.unsqueeze(-1)).squeeze(-1)
        prior = torch.eye(len(project), dtype=torch.float64, device=anomalies.device)
        shift, root, signal = update_weights(prior, weighted @ modes.mT, projected)
        # analysed points = mean + shift modes + coordinate root modes, all linear in the points
        rows = weight + shift.unsqueeze(-2) @ project + coordinate @ root @ project
        return GlobalTransform(rows.mT), signal, screened.reason
