"""Ensemble transform Kalman filter with the symmetric square root."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..observations import Observations, Screened
from .base import EnsembleFilter, GlobalTransform, Target, Transform
from .subspace import update_weights, zero_sum_basis


@dataclass(frozen=True, kw_only=True)
class ETKF(EnsembleFilter):
    """Deterministic global analysis (Bishop, Etherton & Majumdar 2001; symmetric root of Hunt et al. 2007).

    Exact for linear observations and Gaussian errors within the span of the ensemble. The transform is
    computed in the N - 1 coordinates of the error subspace (ESTKF, Nerger et al. 2012), which gives the same
    members and keeps the mean to round-off.
    """

    def _transform(
        self,
        anomalies: Tensor,
        screened: Screened,
        observations: Observations,
        target: Target,
        generator: torch.Generator | None,
    ) -> tuple[Transform, Tensor, Tensor]:
        size = anomalies.shape[-2]
        basis = zero_sum_basis(size, device=anomalies.device)
        modes = basis.mT @ anomalies
        weighted = modes * screened.weight.unsqueeze(-2)
        projected = (weighted @ screened.innovation.unsqueeze(-1)).squeeze(-1)
        matrix, signal = transform_matrix(weighted @ modes.mT, projected, basis)
        return GlobalTransform(matrix), signal, screened.reason


def transform_matrix(gram: Tensor, projected: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """`(..., N, N)` map of members and `(...)` signal from the normal equations of the subspace.

    Column j is the analysed member j: the mean (1/N), its shift, and its own anomaly.
    """
    size = basis.shape[0]
    prior = (size - 1) * torch.eye(size - 1, dtype=torch.float64, device=basis.device)
    shift, root, signal = update_weights(prior, gram, projected)
    anomaly = (size - 1) ** 0.5 * root @ basis.mT
    return basis @ (shift.unsqueeze(-1) + anomaly) + 1 / size, signal
