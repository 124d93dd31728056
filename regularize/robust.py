"""Weights that take the pull out of outliers (peak hops of a tracker), for iterative reweighting."""

import torch

from .errors import InvalidInput

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
    distance = (residual / scale).square().mean(dim=1).sqrt() / CUTOFFS[kind]
    if kind == "huber":
        return 1.0 / distance.clamp(min=1.0)
    return (1.0 - distance.clamp(max=1.0) ** 2) ** 2
