"""LSMR: like LSQR, but the gradient falls monotonically, so that an early stop is safer.

D. Fong and M. Saunders, SIAM J. Sci. Comput. 33 (2011) 2950. Stopping and weights as in ``krylov``.
"""

import torch

from regularize.arguments import POSITIVE, between, checked, finite

from .interface import MOST_ITERATIONS, Limits, Solution
from .krylov import Apply, GolubKahan, iterate


@checked(
    b=finite(None),
    weight=finite(),
    damping=between(0, 1e100),
    tolerance=POSITIVE,
    max_iterations=between(1, MOST_ITERATIONS),
)
def lsmr(
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
    """Minimise |w * (A x - b)|^2 + damping^2 |x|^2; arguments and errors as :func:`regularize.lsqr`."""
    limits = Limits(tolerance, max_iterations, strict)
    return iterate("lsmr", _run, matvec, rmatvec, b, weight, float(damping), limits)


def _run(process: GolubKahan, aim: float, limit: int) -> tuple[torch.Tensor, int]:
    """One run; names as in Fong & Saunders 2011, sec. 5. Damping is rows, as in LSQR."""
    v, alpha, beta = process.v, process.alpha, process.beta
    zeta_bar, alpha_bar, rho, rho_bar, c_bar, s_bar = alpha * beta, alpha, 1.0, 1.0, 1.0, 0.0
    h, h_bar, x = v.clone(), torch.zeros_like(v), torch.zeros_like(v)
    count = 0
    while count < limit:
        count += 1
        process.step()
        v, alpha, beta = process.v, process.alpha, process.beta
        rho_old, rho = rho, (alpha_bar**2 + beta**2) ** 0.5
        c, s = alpha_bar / rho, beta / rho
        theta, alpha_bar = s * alpha, c * alpha
        theta_bar, rho_bar_old = s_bar * rho, rho_bar
        rho_bar = ((c_bar * rho) ** 2 + theta**2) ** 0.5
        c_bar, s_bar = c_bar * rho / rho_bar, theta / rho_bar
        zeta, zeta_bar = c_bar * zeta_bar, -s_bar * zeta_bar
        h_bar = h - (theta_bar * rho / (rho_old * rho_bar_old)) * h_bar
        x = x + (zeta / (rho * rho_bar)) * h_bar
        h = v - (theta / rho) * h
        if abs(zeta_bar) <= 0.9 * aim or alpha == 0 or beta == 0:
            break
    return x.double(), count
