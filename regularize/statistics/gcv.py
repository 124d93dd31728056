"""Curvature by generalised cross-validation: P. Craven and G. Wahba, Numer. Math. 31 (1979) 377.

It assumes the noise of different samples to be independent; where that does not hold (speckle tracking) it
undersmooths, and the restricted likelihood is the better choice. One noise level serves all components, and
no_slip and divergence stay as given.
"""

from math import exp, log

import torch
from scipy.optimize import minimize_scalar

from regularize.solvers.banded import widen
from regularize.solvers.factor import Factor

from .likelihood import SHARPEST, Choice, LikelihoodSearch, Precisions
from .row_groups import PROBES


def cross_validate(search: LikelihoodSearch, no_slip: float | None, rounds: int) -> Choice:
    """Minimise the cross-validation score over the curvature length on the search's grid.

    With robust reweighting the minimum is found anew, up to ``rounds`` times, until the length settles.
    """
    bounds = log(SHARPEST * search.step), log(search.step / SHARPEST)
    length, settled, count = 0.0, False, 0

    def score(logarithm: float) -> float:
        return _evaluate(search, exp(logarithm), no_slip)[0]

    while count < rounds and not settled:
        count += 1
        found = minimize_scalar(score, bounds=bounds, method="bounded", options={"xatol": 0.02})
        settled = search.robust is None or abs(found.x - log(length or 1e-9)) < 0.05
        length = exp(found.x)
        _, variance, x = _evaluate(search, length, no_slip)
        if not settled:
            search.reweigh(x)
    noise = (variance**0.5,) * search.components
    return Choice(noise, length, no_slip, None, search.groups.order, search.factor, count, settled)


def _evaluate(search: LikelihoodSearch, curvature: float, no_slip: float | None) -> tuple[float, float, torch.Tensor]:
    """Score, noise variance and coefficients at one curvature length."""
    one = torch.ones(search.components, dtype=torch.float64)
    scale = search.scale(one)
    slip = 0.0 if search.slip is None or no_slip is None else scale * no_slip**2
    prior, right = search.prior(Precisions(one, search.roughness(scale, curvature), slip, 0.0))
    posterior = Factor(prior + widen(search.data.band, one), search.ordering)
    x = posterior.solve(right + search.data.right)
    used = float((search.data_probes * posterior.solve(search.data_probes)).sum()) / PROBES
    count = search.components * int((search.factor > 0).sum())
    residual = max(search.data.energy(x), 0.0)
    free = max(count - used, 1.0)
    return residual / count / (free / count) ** 2, residual / free, x
