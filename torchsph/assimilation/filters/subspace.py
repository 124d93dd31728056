"""One error subspace, P = L U^-1 L', and its Gaussian update: the algebra that every filter here shares.

The reduced-order unscented filter (Moireau & Chapelle 2011), the SEIK and ESTKF filters (Pham 2001; Nerger et
al. 2012) and the ETKF (Bishop et al. 2001; Hunt et al. 2007) differ in how they choose L and how they draw
members from the result. Between these two ends they do the same thing: with R the observation error
covariance, d the innovation and HL the observed modes,

    U_a = U + (HL)' R^-1 (HL),        mean_a = mean + L U_a^-1 (HL)' R^-1 d.

The matrices of this algebra are as small as the ensemble and kept in float64, also for float32 states.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import AssimilationError


def zero_sum_basis(size: int, *, device: torch.device | str | None = None) -> Tensor:
    """`(N, N-1)` orthonormal columns, each summing to zero (Nerger et al. 2012, Mon. Wea. Rev. 140, eq. 17).

    An ensemble `X (N, n)` with mean m is `m + basis @ L` with `L = basis.T @ X`: N - 1 modes, nothing lost.
    """
    if size < 2:
        raise AssimilationError(f"an ensemble needs at least 2 members, got {size}")
    root = size**-0.5
    basis = torch.eye(size, size - 1, dtype=torch.float64, device=device)
    basis[: size - 1] -= 1 / (size * (root + 1))
    basis[size - 1] = -root
    return basis


def update_weights(prior: Tensor, gram: Tensor, projected: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The Gaussian update in the coordinates of the subspace.

    Args:
        prior: `(..., r, r)` symmetric positive definite U.
        gram: `(..., r, r)`, `(HL)' R^-1 (HL)`.
        projected: `(..., r)`, `(HL)' R^-1 d`.

    Returns:
        shift `(..., r)` = U_a^-1 projected; root `(..., r, r)`, the symmetric U_a^-1/2; signal `(...)`, the
        degrees of freedom that the observations determine, trace(I - U U_a^-1).
    """
    posterior = prior + gram
    if not bool(torch.isfinite(posterior).all()):
        raise AssimilationError("the update is not finite: NaN or overflow in the predicted observations")
    value, vector = torch.linalg.eigh(0.5 * (posterior + posterior.mT))
    if not bool((value[..., 0] > 0).all()):
        raise AssimilationError("the prior precision of the error subspace is not positive definite")
    shift = (vector @ ((vector.mT @ projected.unsqueeze(-1)) / value.unsqueeze(-1))).squeeze(-1)
    root = (vector * value.rsqrt().unsqueeze(-2)) @ vector.mT
    signal = (vector * (gram @ vector)).sum(-2).div(value).sum(-1)
    return shift, root, signal


def update_solution(prior: Tensor, gram: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """`(U + gram)^-1 right` for `right (..., r, k)`, and the signal: `update_weights` where no root is
    needed.
    """
    posterior = prior + gram
    if not bool(torch.isfinite(posterior).all()):
        raise AssimilationError("the update is not finite: NaN or overflow in the predicted observations")
    factor, failed = torch.linalg.cholesky_ex(posterior)
    if bool((failed != 0).any()):
        raise AssimilationError("the prior precision of the error subspace is not positive definite")
    inverse = torch.cholesky_inverse(factor)
    return inverse @ right, (inverse * gram).sum((-2, -1))


@dataclass(frozen=True)
class ErrorSubspace:
    """Mean and covariance `P = L U^-1 L'` of a state of n numbers with r modes.

    Attributes:
        mean: `(*batch, n)`.
        modes: `(*batch, r, n)`, the rows are the columns of L.
        precision: `(*batch, r, r)`, U, float64, symmetric positive definite.
    """

    mean: Tensor
    modes: Tensor
    precision: Tensor

    def __post_init__(self) -> None:
        rank = self.modes.shape[-2]
        if self.precision.shape[-2:] != (rank, rank) or self.modes.shape[-1] != self.mean.shape[-1]:
            raise AssimilationError(
                f"modes {tuple(self.modes.shape)}, precision {tuple(self.precision.shape)} and mean "
                f"{tuple(self.mean.shape)} do not belong to one subspace"
            )

    @classmethod
    def from_ensemble(cls, ensemble: Tensor) -> ErrorSubspace:
        """The sample mean and covariance (divisor N - 1) of `ensemble (*batch, N, n)`, exactly."""
        size = ensemble.shape[-2]
        basis = zero_sum_basis(size, device=ensemble.device)
        wide = ensemble.double()
        identity = torch.eye(size - 1, dtype=torch.float64, device=ensemble.device)
        shape = (*ensemble.shape[:-2], size - 1, size - 1)
        return cls(wide.mean(-2), basis.mT @ wide, ((size - 1) * identity).expand(shape))

    @property
    def rank(self) -> int:
        """Number of modes."""
        return self.modes.shape[-2]

    def square_root(self) -> Tensor:
        """`(*batch, r, n)` modes Z with P = Z' Z: those of this subspace scaled to unit precision."""
        value, vector = torch.linalg.eigh(self.precision)
        return (vector * value.rsqrt().unsqueeze(-2)) @ vector.mT @ self.modes

    def covariance(self) -> Tensor:
        """`(*batch, n, n)`, dense: for small states and for tests."""
        root = self.square_root()
        return root.mT @ root

    def variance(self) -> Tensor:
        """`(*batch, n)`, the diagonal of the covariance."""
        return self.square_root().square().sum(-2)

    def inflated(self, factor: float) -> ErrorSubspace:
        """Standard deviations times `factor` (> 0); PDAF's forgetting factor is 1 / factor^2."""
        if not factor > 0:
            raise AssimilationError(f"inflation must be positive, got {factor}")
        return ErrorSubspace(self.mean, self.modes, self.precision / factor**2)

    def update(self, observed_modes: Tensor, innovation: Tensor, weight: Tensor) -> ErrorSubspace:
        """The analysis given observations with diagonal error covariance.

        Args:
            observed_modes: `(*batch, r, m)`, rows of (HL)'.
            innovation: `(*batch, m)`, observation minus observed mean.
            weight: `(*batch, m)`, 1 / error variance; zero for an observation that is not used.
        """
        weighted = observed_modes * weight.unsqueeze(-2)
        gram = weighted @ observed_modes.mT
        projected = (weighted @ innovation.unsqueeze(-1)).squeeze(-1)
        shift, _, _ = update_weights(self.precision, gram, projected)
        mean = self.mean + (shift.unsqueeze(-2) @ self.modes).squeeze(-2)
        return ErrorSubspace(mean, self.modes, self.precision + gram)

    def plus(self, modes: Tensor) -> ErrorSubspace:
        """With an independent error of covariance `modes' modes` added, `modes (*batch, q, n)`."""
        corner = self.precision.new_zeros(*self.precision.shape[:-2], self.rank, modes.shape[-2])
        unit = torch.eye(modes.shape[-2], dtype=torch.float64, device=modes.device)
        lower = torch.cat([corner.mT, unit.expand(*corner.shape[:-2], -1, -1)], -1)
        precision = torch.cat([torch.cat([self.precision, corner], -1), lower], -2)
        return ErrorSubspace(self.mean, torch.cat([self.modes, modes.double()], -2), precision)

    def truncated(self, rank: int) -> ErrorSubspace:
        """The best approximation of rank `rank`: leading principal components, unit precision.

        Fewer modes than `rank` are filled up with zero modes, so that the number of members stays the same.
        """
        root = self.square_root()
        value, vector = torch.linalg.eigh(root @ root.mT)
        keep = min(rank, self.rank)
        modes = vector[..., self.rank - keep :].mT @ root
        if keep < rank:
            modes = torch.cat([modes, modes.new_zeros(*modes.shape[:-2], rank - keep, modes.shape[-1])], -2)
        unit = torch.eye(rank, dtype=torch.float64, device=root.device)
        return ErrorSubspace(self.mean, modes, unit.expand(*modes.shape[:-2], rank, rank))
