"""LSQR with weights inside the bidiagonalisation, stopping on a gradient that is recomputed.

C. Paige and M. Saunders, LSQR, ACM TOMS 8 (1982); thesis algorithm 2 and eqs. 3.23-3.25. The recurrence's
own estimate of the gradient drifts from the truth (in single precision it claims 1e-10 where the truth
stalls near 1e-4), so it only says when to look: the stop is decided on the gradient recomputed in float64,
and a run whose recurrence was wrong is restarted from where it stands (iterative refinement).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from .errors import InvalidInput, NotConverged

Apply = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Solution:
    """``x`` (unknowns,); ``gradient``: true |A'W(W b - W A x) - damp^2 x| / |A'W W b|; iterations; reason."""

    x: torch.Tensor
    gradient: float
    iterations: int
    reason: str
    solver: str = "lsqr"


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
    handed (b's for the iteration, float64 for the check); ``weight`` (rows,) multiplies rows as in eqs.
    3.24 and 3.25. Raises NotConverged, unless ``strict`` is False, when the true relative gradient stays
    above ``tolerance``.
    """
    options = {"damping": damping, "tolerance": tolerance, "max_iterations": max_iterations, "strict": strict}
    return iterate("lsqr", _bidiagonalise, matvec, rmatvec, b, weight, **options)


def iterate(
    name: str,
    run: Callable[..., tuple[torch.Tensor, int]],
    matvec: Apply,
    rmatvec: Apply,
    b: torch.Tensor,
    weight: torch.Tensor | None,
    *,
    damping: float,
    tolerance: float,
    max_iterations: int,
    strict: bool,
) -> Solution:
    """Run a Krylov method, look at the true gradient, and restart it on the residual while that helps."""
    if tolerance <= 0:
        raise InvalidInput(f"tolerance is {tolerance}: it must be positive")
    w = torch.ones_like(b) if weight is None else weight.to(b.dtype)
    w64, b64 = w.double(), b.double()
    right = rmatvec(w64 * (w64 * b64))
    scale = float(right.norm())
    x = torch.zeros_like(right)
    if scale == 0:
        return Solution(x.to(b.dtype), 0.0, 0, "zero right-hand side", name)
    done, true, reason = 0, 1.0, "iteration limit"
    while done < max_iterations:
        residual, before = w64 * (b64 - matvec(x)), true
        step, used = run(
            lambda v: w * matvec(v),
            lambda u: rmatvec(w * u),
            residual,
            x,
            damping,
            tolerance * scale,
            max_iterations - done,
            b.dtype,
        )
        x = x + step
        done += max(used, 1)
        true = float((rmatvec(w64 * (w64 * (b64 - matvec(x)))) - damping**2 * x).norm()) / scale
        if true <= tolerance:
            return Solution(x.to(b.dtype), true, done, "gradient below tolerance", name)
        if done < max_iterations and true > 0.5 * before:
            reason = "stalled at the precision of the arithmetic"
            break
    solution = Solution(x.to(b.dtype), true, done, reason, name)
    if strict:
        raise NotConverged(
            f"{name}: true relative gradient {true:.2e} after {done} iterations ({reason}), asked for "
            f"{tolerance:.1e}; raise max_iterations or the tolerance, use float64, or solve directly",
            solution,
        )
    return solution


def _bidiagonalise(
    matvec: Apply,
    rmatvec: Apply,
    residual: torch.Tensor,
    x0: torch.Tensor,
    damping: float,
    aim: float,
    limit: int,
    dtype: torch.dtype,
) -> tuple[torch.Tensor, int]:
    """One LSQR run for the correction of x0, in ``dtype``; stops when the estimated gradient is below aim.

    With damping, the rows [damping I] have the residual -damping x0, carried as a second part of u.
    """
    u, low = residual.to(dtype), (-damping * x0).to(dtype)
    beta = norm_of(u, low)
    u, low = u / beta, low / beta
    v = rmatvec(u) + damping * low
    alpha = float(v.norm())
    if alpha == 0:
        return torch.zeros_like(x0), 0
    v = v / alpha
    w, x = v.clone(), torch.zeros_like(v)
    phi_bar, rho_bar = beta, alpha
    count = 0
    while count < limit:
        count += 1
        u, low = matvec(v) - alpha * u, damping * v - alpha * low
        beta = norm_of(u, low)
        if beta > 0:
            u, low = u / beta, low / beta
        v = rmatvec(u) + damping * low - beta * v
        alpha = float(v.norm())
        v = v / alpha if alpha > 0 else v
        rho = (rho_bar**2 + beta**2) ** 0.5
        cosine, sine = rho_bar / rho, beta / rho
        theta, rho_bar = sine * alpha, -cosine * alpha
        phi, phi_bar = cosine * phi_bar, sine * phi_bar
        x = x + (phi / rho) * w
        w = v - (theta / rho) * w
        if abs(alpha * sine * phi) <= 0.9 * aim or alpha == 0 or beta == 0:
            break
    return x.double(), count


def norm_of(u: torch.Tensor, low: torch.Tensor) -> float:
    """Norm of the stacked vector (u, low): the two parts' hypotenuse, summed in float64 whatever their precision."""
    return float((u.double().square().sum() + low.double().square().sum()).sqrt())
