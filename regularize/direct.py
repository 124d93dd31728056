"""Direct solution: banded Cholesky of the normal matrix with float64 refinement on the rows themselves."""

import numpy as np
import torch
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from .assembly import Ordering, normal_band, order
from .errors import InvalidInput, NotConverged
from .krylov import Solution
from .operators import System


class Factor:
    """Cholesky factor of a system's normal matrix; reusable for any right-hand side of the same rows."""

    def __init__(self, system: System, ordering: Ordering | None = None) -> None:
        self.ordering = order(system) if ordering is None else ordering
        self.components, self.unknowns = system.components, system.unknowns
        band = normal_band(system, self.ordering)
        try:
            self._factor = cholesky_banded(band.T, overwrite_ab=True, lower=True, check_finite=False)
        except LinAlgError as error:
            raise InvalidInput(
                "the normal matrix is not positive definite: some coefficients are fixed by no "
                "row; give a curvature or damping above 0"
            ) from error

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """(unknowns,) or (unknowns, k) -> the same shape, float64; untouched coefficients are 0."""
        c = self.components
        full = right.double().reshape(self.unknowns // c, -1)
        active = full[self.ordering.nodes].reshape(len(self.ordering.nodes) * c, -1)
        solved = cho_solve_banded((self._factor, True), active.numpy(), check_finite=False)
        out = torch.zeros_like(full)
        out[self.ordering.nodes] = torch.from_numpy(np.ascontiguousarray(solved)).view(len(active) // c, -1)
        return out.view(right.shape)


def solve_direct(
    system: System,
    *,
    factor: Factor | None = None,
    tolerance: float = 1e-6,
    refinements: int = 3,
    strict: bool = True,
) -> tuple[Solution, Factor]:
    """Solve by Cholesky and refine until the true relative gradient is below ``tolerance``."""
    factor = Factor(system) if factor is None else factor
    right = system.right_side()
    scale = float(right.norm())
    if scale == 0:
        return Solution(torch.zeros_like(right), 0.0, 0, "zero right-hand side", "direct"), factor
    x = factor.solve(right)
    for count in range(1, refinements + 2):
        gradient = system.gradient(x)
        relative = float(gradient.norm()) / scale
        if relative <= tolerance or count == refinements + 1:
            break
        x = x + factor.solve(gradient)
    solution = Solution(x, relative, count, "gradient below tolerance", "direct")
    if relative > tolerance:
        solution = Solution(x, relative, count, "refinement stalled", "direct")
        if strict:
            raise NotConverged(
                f"direct solve: true relative gradient {relative:.2e} after {count - 1} "
                f"refinements, asked for {tolerance:.1e}; the system is nearly singular: raise "
                "curvature or damping, or lower divergence and wall",
                solution,
            )
    return solution, factor
