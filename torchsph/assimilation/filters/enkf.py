"""Stochastic ensemble Kalman filter: each member meets its own perturbed observation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..observations import Observations, Screened
from .base import EnsembleFilter, GlobalTransform, Target, Transform
from .rotation import need_generator
from .subspace import update_solution, zero_sum_basis


@dataclass(frozen=True, kw_only=True)
class StochasticEnKF(EnsembleFilter):
    """Perturbed observations (Burgers, van Leeuwen & Evensen 1998); converges to the Kalman filter with N.

    The perturbations are centred over the members, so that they leave the mean alone. All algebra is in the
    space of members: `K (y + e_j - Hx_j)` equals `A' (U + S S')^-1 S R^-1/2 (y + e_j - Hx_j)`.
    """

    def _transform(
        self,
        anomalies: Tensor,
        screened: Screened,
        observations: Observations,
        target: Target,
        generator: torch.Generator | None,
    ) -> tuple[Transform, Tensor, Tensor]:
        draw = need_generator(generator, "the stochastic filter")
        size = anomalies.shape[-2]
        noise = torch.randn(anomalies.shape, generator=draw, dtype=torch.float64, device=draw.device)
        noise = noise.to(anomalies.device)
        noise = noise - noise.mean(-2, keepdim=True)
        weight = screened.weight.unsqueeze(-2)
        # Scaled by the errors, weight zero gives zero and not 0 * infinity.
        scaled = screened.innovation.unsqueeze(-2) * weight + noise * weight.sqrt() - anomalies * weight
        basis = zero_sum_basis(size, device=anomalies.device)
        modes = basis.mT @ anomalies
        gram = (modes * weight) @ modes.mT
        prior = (size - 1) * torch.eye(size - 1, dtype=torch.float64, device=anomalies.device)
        gain, signal = update_solution(prior, gram, modes @ scaled.mT)
        unit = torch.eye(size, dtype=torch.float64, device=anomalies.device)
        return GlobalTransform(unit + basis @ gain), signal, screened.reason
