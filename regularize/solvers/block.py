"""Block-tridiagonal Cholesky in torch: the direct solver for tensors on a GPU.

A band matrix cut into blocks as wide as the band is block-tridiagonal, so that its factorisation is a chain
of dense products and triangular solves, which is what GPUs are good at. On the CPU LAPACK's banded routine
is faster (it skips the zeros of the outer blocks); there this class serves as the test of itself.
"""

import torch

from regularize.arguments import checked
from regularize.errors import InvalidInput
from regularize.rows.ordering import Ordering

from .banded import dense_block


class BlockFactor:
    """As :class:`regularize.Factor`, from a band (unknowns, width) on any device; the band is kept."""

    def __init__(self, band: torch.Tensor, ordering: Ordering) -> None:
        self.ordering = ordering
        self.size = band.shape[1]  # of its blocks
        self._lower: list[torch.Tensor] = []
        self._below: list[torch.Tensor] = []  # block (k, k - 1) of the factor
        for start in range(0, len(band), self.size):
            diagonal = dense_block(band, start, start)
            diagonal = diagonal + torch.tril(diagonal, -1).mT
            if start > 0:
                below = dense_block(band, start, start - self.size)
                below = torch.linalg.solve_triangular(self._lower[-1], below.mT, upper=False).mT
                diagonal = diagonal - below @ below.mT
                self._below.append(below)
            factor, failed = torch.linalg.cholesky_ex(diagonal)
            if bool(failed != 0):
                raise InvalidInput(
                    "the normal matrix is not positive definite: some coefficients are fixed by no row; give "
                    "a curvature or damping above 0"
                )
            self._lower.append(factor)

    @checked
    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """(active, C) or (active, C, k) in solve order -> the same shape."""
        flat = right.to(self._lower[0]).reshape(right.shape[0] * right.shape[1], -1)
        parts: list[torch.Tensor] = []
        for k, part in enumerate(flat.split(self.size)):
            if k > 0:
                part = part - self._below[k - 1] @ parts[-1]
            parts.append(torch.linalg.solve_triangular(self._lower[k], part, upper=False))
        for k in reversed(range(len(parts))):
            part = parts[k]
            if k + 1 < len(parts):
                part = part - self._below[k].mT @ parts[k + 1]
            parts[k] = torch.linalg.solve_triangular(self._lower[k].mT, part, upper=True)
        return torch.cat(parts).view(right.shape)

    @property
    def blocks(self) -> int:
        """How many blocks its diagonal has."""
        return len(self._lower)

    @checked
    def block(self, row: int, column: int) -> torch.Tensor:
        """Block of the factor on the diagonal, or just below it."""
        return self._lower[row] if row == column else self._below[column]

    def diagonal(self) -> torch.Tensor:
        """(unknowns,) squares of the factor's diagonal."""
        return torch.cat([lower.diagonal() for lower in self._lower]).square()

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the normal matrix."""
        return float(self.diagonal().log().sum())
