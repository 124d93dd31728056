"""Sigma points: few members whose weighted mean and covariance are exactly those of an error subspace.

A rule for rank r gives N points with weights `w (N,)` that sum to one and coordinates `c (N, r)` with
`sum w c = 0` and `sum w c c' = I`. The points of a subspace with modes Z (P = Z'Z) are `mean + c Z`; of
points that a model has moved, the mean is `w X` and the modes are `(w c)' X`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ..errors import AssimilationError
from .rotation import random_rotation
from .subspace import ErrorSubspace, zero_sum_basis


class SigmaPoints(Protocol):
    """A rule; sizes are per experiment, batch dimensions pass through."""

    def size(self, rank: int) -> int:
        """Number of points N for a subspace of rank r."""

    def rank(self, size: int) -> int:
        """Rank r of a set of N points; raises `AssimilationError` where no r gives N."""

    def rule(self, rank: int, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
        """Weights `(N,)` and coordinates `(N, r)`, float64."""

    def gather(self, points: Tensor) -> ErrorSubspace:
        """Mean and covariance of moved points `(*batch, N, n)`, nothing discarded, unit precision."""


@dataclass(frozen=True)
class Simplex:
    """r + 1 points of equal weight, the corners of a regular simplex (Pham 2001, without the random rotation;
    Moireau & Chapelle 2011, ESAIM: COCV 17, section 3.3). Symmetric to second order only."""

    def size(self, rank: int) -> int:
        """See `SigmaPoints.size`."""
        return rank + 1

    def rank(self, size: int) -> int:
        """See `SigmaPoints.rank`."""
        if size < 2:
            raise AssimilationError(f"a simplex needs at least 2 points, got {size}")
        return size - 1

    def rule(self, rank: int, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
        """See `SigmaPoints.rule`."""
        size = rank + 1
        weight = torch.full((size,), 1 / size, dtype=torch.float64, device=device)
        return weight, size**0.5 * zero_sum_basis(size, device=device)

    def gather(self, points: Tensor) -> ErrorSubspace:
        """See `SigmaPoints.gather`."""
        weight, coordinate = self.rule(self.rank(points.shape[-2]), points.device)
        modes = (weight.unsqueeze(-1) * coordinate).mT @ points.double()
        return _unit(points.double().mean(-2), modes)


@dataclass(frozen=True)
class Symmetric:
    """2r + 1 points: the mean, and `mean +- alpha sqrt(r + kappa) Z_j`; third moments vanish exactly.

    The scaled rule of Julier (2002) in the notation of Wan & van der Merwe (2000). With d_i the distances
    from the centre point and mu their weighted mean, its covariance is

        P = sum_i w_i d_i d_i' + (beta - alpha^2) mu mu',

    a sum of squares whenever beta >= alpha^2. That is required here, so that no covariance can lose its
    positivity, however nonlinear the model. With beta = 2 mean and variance of a quadratic function of one
    Gaussian variable are exact for every alpha; a small alpha costs digits in float32 (rounding over alpha).
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        if not self.alpha > 0 or not self.kappa >= 0:
            raise AssimilationError(f"sigma points need alpha > 0 and kappa >= 0, got {self}")
        if self.beta < self.alpha**2:
            raise AssimilationError(
                f"beta = {self.beta} < alpha^2 = {self.alpha**2}: the covariance could become negative; "
                "raise beta (2 for Gaussian errors) or lower alpha"
            )

    def size(self, rank: int) -> int:
        """See `SigmaPoints.size`."""
        return 2 * rank + 1

    def rank(self, size: int) -> int:
        """See `SigmaPoints.rank`."""
        if size < 3 or size % 2 == 0:
            raise AssimilationError(f"a symmetric set has 2 r + 1 points (3, 5, 7 ...), got {size}")
        return (size - 1) // 2

    def rule(self, rank: int, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
        """See `SigmaPoints.rule`."""
        square = self.alpha**2 * (rank + self.kappa)
        weight = torch.full((2 * rank + 1,), 0.5 / square, dtype=torch.float64, device=device)
        weight[0] = 1 - rank / square
        unit = square**0.5 * torch.eye(rank, dtype=torch.float64, device=device)
        return weight, torch.cat([unit[:1] * 0, unit, -unit])

    def gather(self, points: Tensor) -> ErrorSubspace:
        """See `SigmaPoints.gather`."""
        weight, _ = self.rule(self.rank(points.shape[-2]), points.device)
        centre = points[..., :1, :].double()
        distance = points[..., 1:, :].double() - centre
        shift = (weight[1:].unsqueeze(-1) * distance).sum(-2, keepdim=True)
        curved = (self.beta - self.alpha**2) ** 0.5 * shift
        modes = torch.cat([weight[1:].sqrt().unsqueeze(-1) * distance, curved], -2)
        return _unit((centre + shift).squeeze(-2), modes)


def draw_points(subspace: ErrorSubspace, rule: SigmaPoints) -> Tensor:
    """`(*batch, N, n)` float64 sigma points of a subspace."""
    _, coordinate = rule.rule(subspace.rank, subspace.modes.device)
    return subspace.mean.unsqueeze(-2) + coordinate @ subspace.square_root()


def draw_ensemble(subspace: ErrorSubspace, size: int, generator: torch.Generator) -> Tensor:
    """`(*batch, N, n)` float64 members of equal weight, drawn at random with exactly this mean and
    covariance.

    The second-order exact sampling of Pham (2001, Mon. Wea. Rev. 129, 1194): sample mean and covariance
    (divisor N - 1) are those of the subspace, or of its N - 1 leading components where its rank is larger.
    """
    root = subspace.truncated(size - 1).modes
    basis = zero_sum_basis(size, device=root.device)
    batch = tuple(root.shape[:-2])
    mixed = random_rotation(size, generator, batch=batch, device=root.device) @ basis
    return subspace.mean.double().unsqueeze(-2) + (size - 1) ** 0.5 * mixed @ root


def _unit(mean: Tensor, modes: Tensor) -> ErrorSubspace:
    rank = modes.shape[-2]
    unit = torch.eye(rank, dtype=torch.float64, device=modes.device)
    return ErrorSubspace(mean, modes, unit.expand(*modes.shape[:-2], rank, rank))
