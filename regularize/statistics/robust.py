"""Weights that take the pull out of outliers (peak hops of a tracker), for iterative reweighting."""

from functools import lru_cache

import torch

from regularize.errors import InvalidInput

# 95 % efficiency on Gaussian noise: P. Huber, Robust Statistics, 1981; A. Beaton and J. Tukey, Technometrics
# 16 (1974)
CUTOFFS = {"huber": 1.345, "tukey": 4.685}


def robust_weight(residual: torch.Tensor, kind: str, present: torch.Tensor | None = None) -> torch.Tensor:
    """(n,) factors in [0, 1] for the squared rows of samples with residuals (n, C) in m/s.

    Each component is scaled by its own median absolute deviation (over ``present`` samples), and a sample
    is judged by the root mean square of its scaled components, so that a hop in one component discards the
    whole vector.
    """
    if kind not in CUTOFFS:
        raise InvalidInput(f"robust is {kind!r}: choose one of {tuple(CUTOFFS)} or None")
    judged = residual if present is None else residual[present]
    # 1.4826 turns the median absolute deviation into a Gaussian's standard deviation
    scale = 1.4826 * judged.abs().median(dim=0).values
    if not bool((scale > 0).all()):
        return torch.ones_like(residual[:, 0])  # more than half of the residuals vanish: nothing to judge by
    return _factor((residual / scale).square().mean(dim=1), kind)


def _factor(square: torch.Tensor, kind: str) -> torch.Tensor:
    """Weights at squared scaled distances."""
    ratio = square / CUTOFFS[kind] ** 2
    if kind == "huber":
        return ratio.clamp(min=1.0) ** -0.5
    return (1.0 - ratio.clamp(max=1.0)) ** 2


@lru_cache
def inflation(kind: str, components: int) -> float:
    """Ratio by which a weighted fit's residuals understate Gaussian noise: E[w] / E[psi'].

    With it a precision read off the weighted residuals gives the fit the variance that an M-estimator has,
    E[psi^2] / E[psi']^2 (Huber 1981, sec. 6.3). psi_k = w r_k for component k of a Gaussian residual r.
    """
    # the squared norm of a C-vector is chi-square with C degrees of freedom; x is its root
    x = torch.linspace(1e-4, 12.0, 20001, dtype=torch.float64)
    density = x ** (components - 1) * torch.exp(-(x**2) / 2)
    weight = _factor(x**2 / components, kind)
    (slope,) = torch.gradient(weight, spacing=(x,))
    # psi_k' = w + r_k dw/dr_k, averaged over the directions of r
    derivative = weight + slope * x / components
    return float((density * weight).sum() / (density * derivative).sum())
