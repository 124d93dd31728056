"""LSQR with weights inside the bidiagonalisation, stopping on a gradient that is recomputed.

C. Paige and M. Saunders, LSQR, ACM TOMS 8 (1982); Grønli 2017, eq. 3.23, eq. 3.24, eq. 3.25 and algorithm 2. The
recurrence's own estimate of the gradient drifts from the truth (in single precision it claims 1e-10 where the truth
stalls near 1e-4), so it only says when to look: the stop is decided on the gradient recomputed in float64, and a run
whose recurrence was wrong is restarted from where it stands (iterative refinement).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch

from regularize.arguments import POSITIVE, between, checked, finite
from regularize.errors import InvalidInput, NotConverged
from regularize.rows.operators import System
from regularize.rows.sparse import sparse_operators

from .interface import MOST_ITERATIONS, Limits, Neighbour, Solution, Solved

Apply = Callable[[torch.Tensor], torch.Tensor]


class Method(Protocol):
    """:func:`lsqr` and what is called alike."""

    def __call__(
        self,
        matvec: Apply,
        rmatvec: Apply,
        b: torch.Tensor,
        *,
        damping: float,
        tolerance: float,
        max_iterations: int,
        strict: bool,
    ) -> Solution: ...


@dataclass(frozen=True)
class Krylov:
    """The registered solver for a method on rows that are applied, or stored."""

    method: Method

    @property
    def factors(self) -> bool:
        """None."""
        return False

    @property
    def starts_from_neighbour(self) -> bool:
        """Never."""
        return False

    def solve(self, system: System, limits: Limits, neighbour: Neighbour | None = None) -> Solved:
        """By the method, on applied or stored rows."""
        matvec, rmatvec = sparse_operators(system) if limits.stored else (system.matvec, system.rmatvec)
        solution = self.method(
            matvec,
            rmatvec,
            system.target(),
            damping=system.damping,
            tolerance=limits.tolerance,
            max_iterations=limits.max_iterations,
            strict=limits.strict,
        )
        return Solved(solution)


@checked(
    b=finite(None),
    weight=finite(),
    damping=between(0, 1e100),
    tolerance=POSITIVE,
    max_iterations=between(1, MOST_ITERATIONS),
)
def lsqr(
    matvec: Apply,
    rmatvec: Apply,
    b: torch.Tensor,
    *,
    weight: torch.Tensor | None = None,
    damping: float = 0.0,
    tolerance: float = 1e-6,
    max_iterations: int = 5000,
    strict: bool = True,
) -> Solution:
    """Minimise |w * (A x - b)|^2 + damping^2 |x|^2.

    ``matvec`` and ``rmatvec`` apply the UNWEIGHTED matrix and its adjoint in whatever precision they are
    handed (b's for the iteration, float64 for the check); ``weight`` (rows,) multiplies rows as in
    Grønli 2017, eqs. 3.24 and 3.25.

    Raises:
        NotConverged: when the true relative gradient stays above ``tolerance``, unless ``strict`` is False.
    """
    limits = Limits(tolerance, max_iterations, strict)
    return iterate("lsqr", _run, matvec, rmatvec, b, weight, float(damping), limits)


def iterate(
    name: str,
    run: "Callable[[GolubKahan, float, int], tuple[torch.Tensor, int]]",
    matvec: Apply,
    rmatvec: Apply,
    b: torch.Tensor,
    weight: torch.Tensor | None,
    damping: float,
    limits: Limits,
) -> Solution:
    """Run a Krylov method, look at the true gradient, and restart it on the residual while that helps."""
    tolerance, max_iterations = limits.tolerance, limits.max_iterations
    if tolerance <= 0:
        raise InvalidInput(f"tolerance is {tolerance}: it must be positive")
    w = torch.ones_like(b) if weight is None else weight.to(b.dtype)
    if w.shape != b.shape:
        raise InvalidInput(f"weight has the shape {tuple(w.shape)}: it must be that of b, {tuple(b.shape)}")
    w64, b64 = w.double(), b.double()
    right = rmatvec(w64 * (w64 * b64))
    scale = float(right.norm())
    x = torch.zeros_like(right)
    if scale == 0:
        return Solution(x.to(b.dtype), 0.0, 0, "zero right-hand side", name)
    done, true, reason = 0, 1.0, "iteration limit"
    while done < max_iterations:
        seen = matvec(x)
        if seen.shape != b.shape:
            raise InvalidInput(f"matvec gives {tuple(seen.shape)} for the {tuple(b.shape)} of b: they must agree")
        residual, before = w64 * (b64 - seen), true
        process = GolubKahan(lambda v: w * matvec(v), lambda u: rmatvec(w * u), residual, x, damping, b.dtype)
        used = 0
        if process.alpha:
            step, used = run(process, tolerance * scale, max_iterations - done)
            x = x + step
        done += max(used, 1)
        true = float((rmatvec(w64 * (w64 * (b64 - matvec(x)))) - damping**2 * x).norm()) / scale
        if true <= tolerance:
            return Solution(x.to(b.dtype), true, done, "gradient below tolerance", name)
        if done < max_iterations and true > 0.5 * before:
            reason = "stalled at the precision of the arithmetic"
            break
    solution = Solution(x.to(b.dtype), true, done, reason, name)
    if limits.strict:
        raise NotConverged(
            f"{name}: true relative gradient {true:.2e} after {done} iterations ({reason}), asked for "
            f"{tolerance:.1e}; raise max_iterations or the tolerance, use float64, or solve directly",
            solution,
        )
    return solution


class GolubKahan:
    """Golub and Kahan's bidiagonalisation for the correction of x0, in ``dtype``: alpha, beta and v of each step.

    Damping is rows: [damping I] has the residual -damping x0, carried as a second part ``low`` of u.
    """

    def __init__(
        self,
        matvec: Apply,
        rmatvec: Apply,
        residual: torch.Tensor,
        x0: torch.Tensor,
        damping: float,
        dtype: torch.dtype,
    ) -> None:
        self.matvec, self.rmatvec, self.damping = matvec, rmatvec, damping
        self.u, self.low = residual.to(dtype), (-damping * x0).to(dtype)
        self.v, self.alpha = torch.zeros_like(self.low), 0.0
        self._normalise()

    def step(self) -> None:
        """The next alpha, beta, u and v; alpha or beta is 0 where the process has ended."""
        self.u, self.low = self.matvec(self.v) - self.alpha * self.u, self.damping * self.v - self.alpha * self.low
        self._normalise()

    def _normalise(self) -> None:
        # summed in float64 whatever the precision of the parts
        self.beta = float((self.u.double().square().sum() + self.low.double().square().sum()).sqrt())
        if self.beta > 0:
            self.u, self.low = self.u / self.beta, self.low / self.beta
        v = self.rmatvec(self.u) + self.damping * self.low - self.beta * self.v
        self.alpha = float(v.norm())
        self.v = v / self.alpha if self.alpha > 0 else v


def _run(process: GolubKahan, aim: float, limit: int) -> tuple[torch.Tensor, int]:
    """One LSQR run; stops when the estimated gradient is below aim."""
    w, x = process.v.clone(), torch.zeros_like(process.v)
    phi_bar, rho_bar = process.beta, process.alpha
    count = 0
    while count < limit:
        count += 1
        process.step()
        rho = (rho_bar**2 + process.beta**2) ** 0.5
        cosine, sine = rho_bar / rho, process.beta / rho
        theta, rho_bar = sine * process.alpha, -cosine * process.alpha
        phi, phi_bar = cosine * phi_bar, sine * phi_bar
        x = x + (phi / rho) * w
        w = process.v - (theta / rho) * w
        if abs(process.alpha * sine * phi) <= 0.9 * aim or process.alpha == 0 or process.beta == 0:
            break
    return x.double(), count
