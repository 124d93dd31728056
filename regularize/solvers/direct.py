"""Direct solution: banded Cholesky of the normal matrix with float64 refinement on the rows themselves."""

from dataclasses import dataclass

import torch

from regularize.arguments import POSITIVE, between, checked
from regularize.errors import InvalidInput, NotConverged
from regularize.rows.operators import System

from .interface import CholeskyFactor, Limits, Neighbour, Solution, Solved
from .prepared import PreparedSystem

MARGIN = 1e-3  # of the tolerance: a refinement costs little, and small gradients hide errors where penalties are stiff


@dataclass(frozen=True)
class Direct:
    """The registered solver; ``single`` factors in float32 first."""

    single: bool = False

    @property
    def factors(self) -> bool:
        """In float64 alone."""
        return not self.single

    @property
    def starts_from_neighbour(self) -> bool:
        """Never."""
        return False

    def solve(self, system: System, limits: Limits, neighbour: Neighbour | None = None) -> Solved:
        """As :func:`solve_direct`."""
        return solve_direct(system, tolerance=limits.tolerance, single=self.single, strict=limits.strict)


@checked(tolerance=POSITIVE, refinements=between(0, 1000))
def solve_direct(
    system: System | PreparedSystem,
    *,
    factor: CholeskyFactor | None = None,
    start: torch.Tensor | None = None,
    tolerance: float = 1e-6,
    refinements: int = 3,
    single: bool = False,
    strict: bool = True,
) -> Solved:
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
    return Solved(solution, factor)


def _solve_single(prepared: PreparedSystem, right: torch.Tensor, tolerance: float, refinements: int) -> Solved | None:
    """Solution by a float32 factor; None where it cannot reach the tolerance (float64 then has to)."""
    try:
        factor = prepared.single_factor()
    except InvalidInput:  # positive definite in float64 perhaps
        return None
    solution = _refine(prepared, factor, right, tolerance, refinements)
    return Solved(solution, factor) if solution.gradient <= tolerance else None


def _refine(
    prepared: PreparedSystem,
    factor: CholeskyFactor,
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
