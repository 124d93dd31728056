"""Conjugate gradients on the normal equations, preconditioned by the factor of a neighbouring frame.

Frames of a recording differ a little in weights and wall positions, so that one frame's Cholesky factor is
nearly the inverse of the next one's matrix: a handful of iterations replaces assembly and factorisation
(M. Hestenes and E. Stiefel, J. Res. NBS 49, 1952).
"""

import torch

from regularize.arguments import POSITIVE, between, checked
from regularize.errors import InvalidInput, NotConverged
from regularize.rows.operators import System

from .direct import solve_direct
from .interface import MOST_ITERATIONS, CholeskyFactor, Limits, Neighbour, Solution, Solved
from .prepared import PreparedSystem

ITERATIONS = 25  # about what a factorisation costs


class NeighbourGradients:
    """The registered solver: from a neighbouring frame, or directly where there is none or it is too different."""

    @property
    def factors(self) -> bool:
        """Where there is no neighbour."""
        return True

    @property
    def starts_from_neighbour(self) -> bool:
        """Where there is one."""
        return True

    def solve(self, system: System, limits: Limits, neighbour: Neighbour | None = None) -> Solved:
        """As :func:`pcg`, at most ITERATIONS of them; else directly."""
        if neighbour is None:
            return solve_direct(system, tolerance=limits.tolerance, strict=limits.strict)
        if neighbour.factor is None or neighbour.knots != system.knots:
            raise InvalidInput(
                "neighbour holds no factor of the same knot grid: fit it with solver='pcg' and the same box"
            )
        prepared, start = PreparedSystem(system), neighbour.coefficients
        solution = pcg(
            prepared,
            neighbour.factor,
            start=start,
            tolerance=limits.tolerance,
            max_iterations=ITERATIONS,
            strict=False,
        )
        if solution.gradient <= limits.tolerance:
            return Solved(solution, neighbour.factor)
        # a neighbour too different costs more iterations than a factorisation of its own
        return solve_direct(prepared, tolerance=limits.tolerance, strict=limits.strict)


class NeighbourPreconditioner:
    """Applies another system's inverse on the coefficients both touch, and the diagonal's on the others."""

    def __init__(self, prepared: PreparedSystem, factor: CholeskyFactor) -> None:
        old, new = factor.ordering, prepared.ordering
        self.factor = factor
        place = torch.full((new.knots.nodes,), -1, dtype=torch.int64, device=old.nodes.device)
        place[old.nodes] = torch.arange(len(old.nodes), device=old.nodes.device)
        self.old_place = place[new.nodes]
        self.known = self.old_place >= 0
        # rows of unit size make a fair guess of the diagonal where the neighbour knows nothing
        self.other = float(factor.diagonal().median())

    def __call__(self, r: torch.Tensor) -> torch.Tensor:
        inner = torch.zeros(len(self.factor.ordering.nodes), r.shape[1], dtype=r.dtype, device=r.device)
        inner[self.old_place[self.known]] = r[self.known]
        out = r / self.other
        out[self.known] = self.factor.solve(inner)[self.old_place[self.known]]
        return out


@checked(tolerance=POSITIVE, max_iterations=between(1, MOST_ITERATIONS))
def pcg(
    prepared: PreparedSystem,
    factor: CholeskyFactor,
    *,
    start: torch.Tensor | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 200,
    strict: bool = True,
) -> Solution:
    """Solve ``prepared`` with the ``factor`` of a similar system; ``start`` (nodes, C) as a first guess.

    Stops on the true relative gradient, recomputed from the rows in float64; raises NotConverged unless
    ``strict`` is False.
    """
    precondition = NeighbourPreconditioner(prepared, factor)
    right = prepared.gradient()
    scale = float(right.norm())
    x = torch.zeros_like(right) if start is None else start.double()[prepared.ordering.nodes]
    if scale == 0:
        return Solution(prepared.expand(right).flatten(), 0.0, 0, "zero right-hand side", "pcg")
    residual = right if start is None else prepared.gradient(x)
    direction, energy, count, relative = None, 0.0, 0, float(residual.norm()) / scale
    while relative > tolerance and count < max_iterations:
        count += 1
        guess = precondition(residual)
        new_energy = float((residual * guess).sum())
        direction = guess if direction is None else guess + (new_energy / energy) * direction
        energy = new_energy
        pushed = right - prepared.gradient(direction)
        step = energy / float((direction * pushed).sum())
        x = x + step * direction
        residual = residual - step * pushed
        relative = float(residual.norm()) / scale
        if relative <= tolerance:  # the recurrence says so: look
            residual, direction = prepared.gradient(x), None
            relative = float(residual.norm()) / scale
    reason = "gradient below tolerance" if relative <= tolerance else "iteration limit"
    solution = Solution(prepared.expand(x).flatten(), relative, count, reason, "pcg")
    if relative > tolerance and strict:
        raise NotConverged(
            f"conjugate gradients: true relative gradient {relative:.2e} after {count} iterations, asked for "
            f"{tolerance:.1e}; the neighbour's factor is too different: solve directly",
            solution,
        )
    return solution
