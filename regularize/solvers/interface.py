"""What a linear solver is given and what it returns; ``registry`` lists the solvers by name."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch

from regularize.basis.knots import Knots
from regularize.rows.operators import System
from regularize.rows.ordering import Ordering

MOST_ITERATIONS = 1_000_000


@dataclass(frozen=True)
class Solution:
    """Coefficients, and how well they solve the system.

    Args:
        x: (unknowns,), over all coefficients of the knot grid.
        gradient: true relative gradient |A'W(W b - W A x) - damping^2 x| / |A'W W b|, recomputed in float64.
        iterations: or solves, for a direct solver.
        reason: why it stopped.
        solver: its name.
    """

    x: torch.Tensor
    gradient: float
    iterations: int
    reason: str
    solver: str


@dataclass(frozen=True)
class Limits:
    """When a solver may stop.

    Args:
        tolerance: true relative gradient that is small enough.
        max_iterations: of an iterative solver.
        strict: raise NotConverged where the tolerance is not reached.
        stored: iterative solvers store the matrix and its transpose instead of applying rows.
    """

    tolerance: float = 1e-6
    max_iterations: int = 5000
    strict: bool = True
    stored: bool = False


class CholeskyFactor(Protocol):
    """A factor L L' of the normal matrix in solve order, band or blocks, on any device."""

    ordering: Ordering

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """(active, C) or (active, C, k) -> the same shape."""

    @property
    def size(self) -> int:
        """Rows of the blocks of :meth:`block`, which couple with their neighbours alone."""

    @property
    def blocks(self) -> int:
        """How many blocks the diagonal has."""

    def block(self, row: int, column: int) -> torch.Tensor:
        """Block of L on the diagonal, or just below it."""

    def diagonal(self) -> torch.Tensor:
        """(unknowns,) squares of the diagonal of L: conditional precisions."""

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the normal matrix."""


@dataclass(frozen=True)
class Neighbour:
    """The solved system of a like frame, to start from.

    Args:
        knots: its knot grid.
        coefficients: (nodes, C), m/s.
        factor: of its normal matrix; None where it kept none.
    """

    knots: Knots
    coefficients: torch.Tensor
    factor: CholeskyFactor | None


class Solved(NamedTuple):
    """A solution, with a factor of the system or of one like it where the solver has one."""

    solution: Solution
    factor: CholeskyFactor | None = None


class LinearSolver(Protocol):
    """Minimises |A x - b|^2 + damping^2 |x|^2 for the rows of a system.

    Adding one: a file here with a class that has these three members, a line in ``registry``, a line in README.md. The
    tests of ``tests/regularize/solvers/test_battery.py`` then run on it by themselves.
    """

    @property
    def factors(self) -> bool:
        """Whether ``solve`` without a neighbour returns the system's own factor in float64."""

    @property
    def starts_from_neighbour(self) -> bool:
        """Whether ``solve`` uses a neighbour, so that its own factor has to be kept for the next frame."""

    def solve(self, system: System, limits: Limits, neighbour: Neighbour | None = None) -> Solved:
        """Solve to the limits; ``neighbour`` may be ignored.

        Raises:
            InvalidInput: a system that is not positive definite, a neighbour on other knots.
            NotConverged: the tolerance was not reached and the limits are strict.
        """
