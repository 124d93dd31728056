"""Banded Cholesky factor on the CPU, by the compiled band algebra or the one in torch."""

import numpy as np
import torch
from scipy.linalg.blas import dtbmv

from regularize.arguments import checked
from regularize.errors import InvalidInput
from regularize.native import library as native
from regularize.native.checks import check_band
from regularize.rows.ordering import Ordering

from . import cholesky
from .banded import dense_block
from .blas_threads import one_thread


class Factor:
    """Cholesky factor of a normal matrix; serves any right-hand sides of the same rows and weights.

    ``band`` (unknowns, width) is the lower band as in :func:`regularize.rows.assembly.empty_band`, float64 or
    float32; it is overwritten.
    """

    def __init__(self, band: torch.Tensor, ordering: Ordering) -> None:
        active = len(ordering.nodes)
        if band.ndim != 2 or len(band) == 0 or len(band) % active:
            raise InvalidInput(
                f"the band has the shape {tuple(band.shape)}: it must have a row for each component of the {active} "
                "coefficients of its ordering"
            )
        self.ordering, self.band = ordering, band
        self.reach = ordering.reach(len(band) // active)
        check_band(band, self.reach)
        self._algebra = native if native.available() else cholesky
        if not self._algebra.factorise(band, self.reach):
            raise InvalidInput(
                "the normal matrix is not positive definite: some coefficients are fixed by no row; give a "
                "curvature or damping above 0"
            )

    @checked
    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """(active, C) or (active, C, k) in solve order -> the same shape."""
        if right.device != self.band.device or right.ndim == 0 or right.numel() % len(self.band):
            raise InvalidInput(
                f"the right-hand side has the shape {tuple(right.shape)} on '{right.device}': it must hold columns of "
                f"{len(self.band)} numbers on '{self.band.device}'"
            )
        flat = right.reshape(len(self.band), -1).to(self.band.dtype)
        solved = self._algebra.solve(self.band, self.reach, flat, lower=True, upper=True)
        return solved.double().view(right.shape)

    def spread(self, white: torch.Tensor) -> torch.Tensor:
        """The factor times white (unknowns, k): draws whose covariance is the factored matrix."""
        band = self.band.numpy().T  # LAPACK's layout
        with one_thread():
            columns = [dtbmv(len(band) - 1, band, z, lower=1) for z in white.T.contiguous().numpy()]
        return torch.from_numpy(np.stack(columns, axis=1))

    def sample(self, precision: float, generator: torch.Generator) -> torch.Tensor:
        """(active, C) Gaussian draw of mean 0 with ``precision`` times the factored matrix as precision."""
        return self.samples(precision, 1, generator)[..., 0]

    def samples(self, precision: float, count: int, generator: torch.Generator) -> torch.Tensor:
        """(active, C, count) draws as of :meth:`sample` one after the other, by one pass over the factor."""
        sides = (torch.randn(len(self.band), 1, generator=generator, dtype=torch.float64) for _ in range(count))
        # L' x = z gives x the covariance (L L')^-1
        draws = self._algebra.solve(self.band, self.reach, torch.cat(list(sides), 1), lower=False, upper=True)
        return draws.view(len(self.ordering.nodes), -1, count) / precision**0.5

    @property
    def size(self) -> int:
        """Rows of the blocks that :meth:`block` cuts the factor into, which couple with their neighbours alone."""
        return self.band.shape[1]

    @property
    def blocks(self) -> int:
        """How many blocks its diagonal has."""
        return -(-len(self.band) // self.size)

    @checked
    def block(self, row: int, column: int) -> torch.Tensor:
        """Block of the factor on the diagonal, or just below it."""
        return dense_block(self.band, row * self.size, column * self.size)

    def diagonal(self) -> torch.Tensor:
        """(unknowns,) squares of the factor's diagonal: conditional precisions, a guess of the matrix's."""
        return self.band[:, 0].double().square()

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the normal matrix."""
        return 2.0 * float(self.band[:, 0].log().sum())
