"""Direct solution: banded Cholesky of the normal matrix with float64 refinement on the rows themselves."""

from copy import copy

import numpy as np
import torch
from scipy.linalg.blas import dtbmv

from regularize.errors import InvalidInput, NotConverged
from regularize.native import gram_triton
from regularize.native import library as native
from regularize.rows.assembly import reference_band
from regularize.rows.operators import System
from regularize.rows.ordering import Ordering, order

from . import cholesky
from .banded import dense_block, to_single
from .block import BlockFactor
from .krylov import Solution

MARGIN = 1e-3  # of the tolerance: a refinement costs little, and small gradients hide errors where penalties are stiff
SHIFT = 1e-13  # of the largest diagonal entry; a few hundred times the rounding of float64


class PreparedSystem:
    """A system in solve order with its normal matrix and gradient, compiled or in torch.

    Vectors are (active coefficients, C) in solve order. ``engine`` "native" (compiled, CPU), "triton" (GPU)
    or "reference" (torch, anywhere); None picks the fast one of the device where it is installed.
    """

    def __init__(self, system: System, ordering: Ordering | None = None, engine: str | None = None) -> None:
        self.system = system
        self.ordering = order(system) if ordering is None else ordering
        if engine == "native" and not native.available():
            raise InvalidInput("engine is 'native' but no compiled library was built; use 'reference'")
        device = self.ordering.nodes.device
        if engine == "triton" and not gram_triton.available(device):
            raise InvalidInput(f"engine is 'triton', which cannot run on {device} here; use 'reference'")
        self.engine = engine or self._fastest(device)
        self._packed = native.PackedSystem(system, self.ordering) if self.engine == "native" else None

    @staticmethod
    def _fastest(device: torch.device) -> str:
        if device.type == "cpu":
            return "native" if native.available() else "reference"
        return "triton" if gram_triton.available(device) else "reference"

    def with_targets(self, system: System) -> "PreparedSystem":
        """The same rows in the same order with the right-hand sides of ``system``."""
        other = copy(self)
        other.system = system
        if self._packed is not None:
            other._packed = copy(self._packed)
            other._packed.system = system
        return other

    def with_weights(self, system: System) -> "PreparedSystem":
        """The same points in the same order with the weights and right-hand sides of ``system``."""
        other = copy(self)
        other.system = system
        if self._packed is not None:
            other._packed = self._packed.with_weights(system)
        return other

    def band(self) -> torch.Tensor:
        """Lower band (unknowns, width) of the normal matrix, float64."""
        if self._packed is not None:
            return self._packed.band()
        assemble = gram_triton.triton_band if self.engine == "triton" else reference_band
        return assemble(self.system, self.ordering)

    def single_factor(self) -> "Factor | BlockFactor":
        """Cholesky factor in float32, in half the time; InvalidInput where it breaks down.

        The peak of memory is that of the float64 band, in whose place it is made.
        """
        if self.ordering.nodes.device.type == "cpu":
            return Factor(to_single(self.band()), self.ordering)
        return BlockFactor(self.band().float(), self.ordering)

    def factor(self) -> "Factor | BlockFactor":
        """Cholesky factor of the normal matrix; InvalidInput where it is not positive definite.

        Penalties many orders stronger than the damping can lose it to round-off: then the diagonal is raised
        by SHIFT of its largest entry, which the refinement on the rows has to make good for.
        """
        kind = Factor if self.ordering.nodes.device.type == "cpu" else BlockFactor
        try:
            return kind(self.band(), self.ordering)
        except InvalidInput:
            if self.system.damping == 0:
                raise
            band = self.band()
            band[:, 0] += SHIFT * band[:, 0].max()
            return kind(band, self.ordering)

    def gradient(self, x: torch.Tensor | None = None) -> torch.Tensor:
        """A'(b - A x) - damping^2 x, or A'b."""
        if self._packed is not None:
            return self._packed.gradient(x)
        if x is None:
            return self._take(self.system.right_side())
        return self._take(self.system.gradient(self.expand(x).flatten()))

    def expand(self, x: torch.Tensor) -> torch.Tensor:
        """(active, C) in solve order -> (nodes, C) with zeros at untouched coefficients."""
        return self.ordering.expand(x)

    def _take(self, full: torch.Tensor) -> torch.Tensor:
        return full.view(self.system.knots.nodes, self.system.components)[self.ordering.nodes]


class Factor:
    """Cholesky factor of a normal matrix; serves any right-hand sides of the same rows and weights.

    ``band`` (unknowns, width) is the lower band as in :func:`regularize.assembly.empty_band`, float64 or
    float32; it is overwritten.
    """

    def __init__(self, band: torch.Tensor, ordering: Ordering) -> None:
        self.ordering, self.band = ordering, band
        self.reach = ordering.reach(len(band) // len(ordering.nodes))
        self._algebra = native if native.available() and band.is_contiguous() else cholesky
        if not self._algebra.factorise(band, self.reach):
            raise InvalidInput(
                "the normal matrix is not positive definite: some coefficients are fixed by no row; give a "
                "curvature or damping above 0"
            )

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """(active, C) or (active, C, k) in solve order -> the same shape."""
        flat = right.reshape(len(self.band), -1).to(self.band.dtype)
        solved = self._algebra.solve(self.band, self.reach, flat, lower=True, upper=True)
        return solved.double().view(right.shape)

    def spread(self, white: torch.Tensor) -> torch.Tensor:
        """The factor times white (unknowns, k): draws whose covariance is the factored matrix."""
        band = self.band.numpy().T  # LAPACK's layout
        columns = [dtbmv(len(band) - 1, band, z, lower=1) for z in white.T.contiguous().numpy()]
        return torch.from_numpy(np.stack(columns, axis=1))

    def sample(self, precision: float, generator: torch.Generator) -> torch.Tensor:
        """(active, C) Gaussian draw of mean 0 with ``precision`` times the factored matrix as precision."""
        white = torch.randn(len(self.band), 1, generator=generator, dtype=torch.float64)
        # L' x = z gives x the covariance (L L')^-1
        draw = self._algebra.solve(self.band, self.reach, white, lower=False, upper=True)
        return draw.view(len(self.ordering.nodes), -1) / precision**0.5

    @property
    def size(self) -> int:
        """Rows of the blocks that :meth:`block` cuts the factor into, which couple with their neighbours alone."""
        return self.band.shape[1]

    @property
    def blocks(self) -> int:
        """How many blocks its diagonal has."""
        return -(-len(self.band) // self.size)

    def block(self, row: int, column: int) -> torch.Tensor:
        """Block of the factor on the diagonal, or just below it."""
        return dense_block(self.band, row * self.size, column * self.size)

    def diagonal(self) -> torch.Tensor:
        """(unknowns,) squares of the factor's diagonal: conditional precisions, a guess of the matrix's."""
        return self.band[:, 0].double().square()

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the normal matrix."""
        return 2.0 * float(self.band[:, 0].log().sum())


def solve_direct(
    system: System | PreparedSystem,
    *,
    factor: Factor | None = None,
    start: torch.Tensor | None = None,
    tolerance: float = 1e-6,
    refinements: int = 3,
    single: bool = False,
    strict: bool = True,
) -> tuple[Solution, Factor]:
    """Solve by Cholesky and refine until the true relative gradient is below ``tolerance``.

    ``Solution.x`` is (nodes * C,) over all coefficients of the knot grid. A given ``factor`` (of the same
    rows, or of similar ones) is used instead of a new one. ``start`` (active, C): a first solution in solve order,
    in place of the factor's. ``single`` tries a float32 factor, refined in float64 on the rows, and goes on to a
    float64 one where that breaks down or stalls. Raises NotConverged unless ``strict`` is False.
    """
    prepared = system if isinstance(system, PreparedSystem) else PreparedSystem(system)
    right = prepared.gradient()
    if single and factor is None:
        found = _solve_single(prepared, right, tolerance, refinements)
        if found is not None:
            return found
    factor = prepared.factor() if factor is None else factor
    solution = _refine(prepared, factor, right, tolerance, refinements, start)
    if solution.gradient > tolerance and strict:
        raise NotConverged(
            f"direct solve: true relative gradient {solution.gradient:.2e} after {solution.iterations - 1} "
            f"refinements, asked for {tolerance:.1e}; the system is nearly singular: raise curvature or "
            "damping, or lower divergence and wall",
            solution,
        )
    return solution, factor


def _solve_single(
    prepared: PreparedSystem, right: torch.Tensor, tolerance: float, refinements: int
) -> tuple[Solution, Factor] | None:
    """Solution by a float32 factor; None where it cannot reach the tolerance (float64 then has to)."""
    try:
        factor = prepared.single_factor()
    except InvalidInput:  # positive definite in float64 perhaps
        return None
    solution = _refine(prepared, factor, right, tolerance, refinements)
    return (solution, factor) if solution.gradient <= tolerance else None


def _refine(
    prepared: PreparedSystem,
    factor: Factor,
    right: torch.Tensor,
    tolerance: float,
    refinements: int,
    start: torch.Tensor | None = None,
) -> Solution:
    """Solve and refine until the gradient, recomputed on the rows, is small or no longer halves."""
    scale = float(right.norm())
    if scale == 0:
        x = prepared.expand(torch.zeros_like(right)).flatten()
        return Solution(x, 0.0, 0, "zero right-hand side", "direct")
    x, best, least = factor.solve(right) if start is None else start, None, float("inf")
    for count in range(1, refinements + 2):
        gradient = prepared.gradient(x)
        relative, before = float(gradient.norm()) / scale, least
        if relative < least:
            best, least = x, relative
        if least <= MARGIN * tolerance or count == refinements + 1 or not relative < 0.5 * before:
            break
        x = x + factor.solve(gradient)
    best = x if best is None else best
    reason = "gradient below tolerance" if least <= tolerance else "refinement stalled"
    return Solution(prepared.expand(best).flatten(), least, count, reason, "direct")
