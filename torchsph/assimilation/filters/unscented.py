"""Unscented Kalman filter with the full covariance, for states of up to a few hundred numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..observations import Observations, count_reasons, screen
from .sigma import SigmaPoints, Symmetric, draw_points
from .subspace import ErrorSubspace


@dataclass(frozen=True)
class UnscentedUpdate:
    """Analysed state and the innovation's statistics, `(*batch, m)`; `nis` is `(*batch,)`."""

    state: ErrorSubspace
    reason: Tensor
    innovation: Tensor
    innovation_variance: Tensor
    nis: Tensor

    def counts(self) -> dict[str, int]:
        """Number of observations per `Reason`, those used among them."""
        return count_reasons(self.reason)


@dataclass(frozen=True)
class UnscentedFilter:
    """Julier & Uhlmann (1997) in square-root form: the state carries Z with P = Z'Z, never P.

    The update `P_a = Z' (I + Y R^-1 Y')^-1 Z`, with Y the observed modes, equals `P - K P_yy K'` and cannot
    lose positivity. Exactly the Kalman filter on linear problems.

    Attributes:
        points: the sigma-point rule, for predictions and for observations.
        gross_error: reject innovations beyond so many standard deviations; None accepts all.
    """

    points: SigmaPoints = field(default_factory=Symmetric)
    gross_error: float | None = None

    def start(self, mean: Tensor, covariance: Tensor) -> ErrorSubspace:
        """A Gaussian state from `mean (*batch, n)` and positive semi-definite `covariance (*batch, n, n)`."""
        value, vector = torch.linalg.eigh(covariance.double())
        scale = value.abs().amax(-1, keepdim=True)
        if bool((value < -1e-6 * scale).any()):
            raise AssimilationError("the initial covariance has negative eigenvalues")
        modes = value.clamp(min=0).sqrt().unsqueeze(-1) * vector.mT
        unit = torch.eye(mean.shape[-1], dtype=torch.float64, device=mean.device)
        return ErrorSubspace(mean, modes, unit.expand_as(modes))

    def predict(
        self, state: ErrorSubspace, model: Callable[[Tensor], Tensor], noise: Tensor | None = None
    ) -> ErrorSubspace:
        """Through `model: (*batch, N, n) -> (*batch, N, n)`; `noise (q, n)` adds the covariance noise'
        noise.
        """
        moved = self.points.gather(model(draw_points(state, self.points).to(state.mean.dtype)))
        if noise is not None:
            moved = moved.plus(noise.double().expand(*moved.modes.shape[:-2], *noise.shape))
        return _stored(moved, state.mean.dtype)

    def update(
        self, state: ErrorSubspace, operator: Callable[[Tensor], Tensor], observations: Observations
    ) -> UnscentedUpdate:
        """Given `observations` of `operator: (*batch, N, n) -> (*batch, N, m)`."""
        points = draw_points(state, self.points)
        count = points.shape[-1]
        seen = operator(points.to(state.mean.dtype)).double()
        joint = self.points.gather(torch.cat([points, seen], -1))
        observed, modes = joint.modes[..., count:], joint.modes[..., :count]
        screened = screen(observations, joint.mean[..., count:], observed.square().sum(-2), self.gross_error)
        observed = torch.where(screened.used.unsqueeze(-2), observed, 0.0)
        prior = ErrorSubspace(state.mean.double(), modes, joint.precision)
        posterior = prior.update(observed, screened.innovation, screened.weight)
        return UnscentedUpdate(
            state=_stored(posterior, state.mean.dtype),
            reason=screened.reason,
            innovation=observations.value.double() - joint.mean[..., count:],
            innovation_variance=screened.predicted_variance + screened.variance,
            nis=_nis(observed, screened.innovation, screened.weight),
        )


def _stored(state: ErrorSubspace, dtype: torch.dtype) -> ErrorSubspace:
    """n unit-precision modes by QR (P = R'R), rounded to the state's dtype: still a covariance."""
    factor = torch.linalg.qr(state.square_root(), mode="r").R
    count, size = factor.shape[-2:]
    if count < size:
        factor = torch.cat([factor, factor.new_zeros(*factor.shape[:-2], size - count, size)], -2)
    unit = torch.eye(size, dtype=torch.float64, device=factor.device)
    return ErrorSubspace(state.mean.to(dtype), factor.to(dtype).double(), unit.expand_as(factor))


def _nis(observed: Tensor, innovation: Tensor, weight: Tensor) -> Tensor:
    """d' (Y'Y + R)^-1 d by the small inverse: d'R^-1 d - (Y R^-1 d)' (I + Y R^-1 Y')^-1 (Y R^-1 d)."""
    scaled = (observed * weight.unsqueeze(-2)) @ innovation.unsqueeze(-1)
    unit = torch.eye(observed.shape[-2], dtype=torch.float64, device=observed.device)
    inner = unit + (observed * weight.unsqueeze(-2)) @ observed.mT
    explained = (scaled * torch.linalg.solve(inner, scaled)).sum((-2, -1))
    return (innovation.square() * weight).sum(-1) - explained
