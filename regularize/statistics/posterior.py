"""Posterior covariance of the fitted field, from the Cholesky factor.

Read as a Gaussian model, the cost times a precision (the inverse of the noise variance, times the weight of
all samples) is minus twice a log-posterior, so its normal matrix is the posterior precision of the
coefficients. The blocks of its inverse inside the band are found exactly by the backward recursion of
K. Takahashi et al. (1973; see H. Rue and L. Held, Gaussian Markov Random Fields, 2005, sec. 2.4) on blocks
as wide as the band.
"""

import torch

from regularize.arguments import checked
from regularize.basis.knots import Knots
from regularize.solvers.interface import CholeskyFactor


class Posterior:
    """Variances of the field; ``precision`` turns the normal matrix into that of a log-posterior.

    ``inflation`` (C,): factors on the standard deviations, for samples whose errors are correlated.
    """

    def __init__(
        self, factor: CholeskyFactor, precision: float, components: int, inflation: torch.Tensor | None = None
    ) -> None:
        self.ordering, self.components, self.precision = factor.ordering, components, precision
        self.inflation = torch.ones(components, dtype=torch.float64) if inflation is None else inflation
        self._factor = factor
        self._blocks: list[tuple[torch.Tensor, torch.Tensor | None]] | None = None

    @checked
    def variance(self, points: torch.Tensor) -> torch.Tensor:
        """(n, C) in (m/s)^2 at points (n, A), which must lie in cells that hold rows."""
        knots: Knots = self.ordering.knots
        cell, t = knots.locate(points.double())
        slot = self.ordering.slots(cell)
        basis = knots.stencil(t)[:, self.ordering.local()]
        out = torch.empty(len(points), self.components, dtype=torch.float64, device=points.device)
        for number in torch.unique(slot):
            here = slot == number
            covariance = self._cell_covariance(self.ordering.position[number])
            out[here] = torch.einsum("nl,clm,nm->nc", basis[here], covariance, basis[here])
        return out / self.precision * self.inflation.to(out).square()

    def _cell_covariance(self, position: torch.Tensor) -> torch.Tensor:
        """(C, L, L) covariance of each component's coefficients in one cell, times the precision."""
        if self._blocks is None:
            self._blocks = self._invert()
        size = self._factor.size
        unknown = position * self.components + torch.arange(self.components, device=position.device)[:, None]
        first = int(unknown.min()) // size
        diagonal, below = self._blocks[first]
        local = unknown - first * size
        if below is None:
            return torch.stack([diagonal[i][:, i] for i in local])
        following = self._blocks[first + 1][0]
        return torch.stack([_across(diagonal, below, following, i) for i in local])

    def _invert(self) -> list[tuple[torch.Tensor, torch.Tensor | None]]:
        """Blocks (k, k) and (k + 1, k) of the inverse, each as wide as the band."""
        done: list[tuple[torch.Tensor, torch.Tensor | None]] = []
        following: torch.Tensor | None = None
        for k in reversed(range(self._factor.blocks)):
            lower = self._factor.block(k, k)
            eye = torch.eye(len(lower), dtype=torch.float64, device=lower.device)
            inverse = torch.linalg.solve_triangular(lower, eye, upper=False)
            if following is None:
                diagonal, below = inverse.T @ inverse, None
            else:
                # Z_kk = L_kk^-T (I + B' Z B) L_kk^-1 and Z_k+1,k = -Z B L_kk^-1 with B = L_k+1,k
                coupling = self._factor.block(k + 1, k) @ inverse
                below = -(following @ coupling)
                diagonal = inverse.T @ inverse - coupling.T @ below
            done.append((diagonal, below))
            following = diagonal
        return done[::-1]


def _across(diagonal: torch.Tensor, below: torch.Tensor, following: torch.Tensor, i: torch.Tensor) -> torch.Tensor:
    """Rows and columns i, rising, of the symmetric matrix of two blocks and the one below between them."""
    size = len(diagonal)
    own, other = i[i < size], i[i >= size] - size
    between = below[other][:, own]
    upper = torch.cat([diagonal[own][:, own], between.T], dim=1)
    return torch.cat([upper, torch.cat([between, following[other][:, other]], dim=1)])
