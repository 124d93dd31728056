"""Observation errors that neighbours share: how much such observations are worth, and thinning them.

All filters here take independent errors. Overlapping tracking kernels make them correlated, and m correlated
observations taken as independent ones collapse the ensemble. Two cures: less weight for each, or fewer.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .errors import AssimilationError


def redundancy(
    position: Tensor, correlation: Callable[[Tensor], Tensor], reach: float, *, used: Tensor | None = None
) -> Tensor:
    """`(q,)` factor >= 1 by which the weight of each observation is to be divided: the row sums of the
    correlation matrix.

    For errors with correlation matrix C the information about a signal that is smooth over the correlation
    length is `1' (s C)^-1 1`, which equals `sum 1 / (s rowsum)` exactly where C is circulant, i.e. away from
    edges. Pass it as `Observations.redundancy`.

    Args:
        position: `(q, D)`; each component of a vector counts for itself.
        correlation: of the distance, 1 at 0; taken as zero at and beyond `reach`.
        used: `(q,)` bool; observations that are not used do not count as neighbours.
    """
    if not reach > 0:
        raise AssimilationError(f"the reach of the correlation must be positive, got {reach}")
    place = position.double()
    others = place if used is None else place[used]
    step = max(1, 20_000_000 // max(1, len(others)))
    sums = []
    for part in place.split(step):
        distance = torch.cdist(part, others, compute_mode="donot_use_mm_for_euclid_dist")
        near = torch.where(distance < reach, correlation(distance), 0.0)
        sums.append(near.sum(-1))
    return torch.cat(sums).clamp(min=1.0) if sums else place.new_zeros(0)


def gaussian_correlation(length: float) -> Callable[[Tensor], Tensor]:
    """`exp(-r^2 / (2 length^2))`: errors smoothed with a Gaussian of standard deviation length / sqrt(2)."""
    if not length > 0:
        raise AssimilationError(f"the correlation length must be positive, got {length}")
    return lambda distance: torch.exp(-0.5 * (distance / length).square())


def thin(position: Tensor, distance: float, *, priority: Tensor | None = None) -> Tensor:
    """`(q,)` bool: the observation of highest `priority (q,)` (a weight, say) in each cell of size
    `distance`.

    Without priorities the first of each cell. Give the others the reason `THINNED`.
    """
    if not distance > 0:
        raise AssimilationError(f"the thinning distance must be positive, got {distance}")
    keep = torch.zeros(len(position), dtype=torch.bool, device=position.device)
    if not len(position):
        return keep
    rank = torch.zeros(len(position), dtype=torch.float64, device=position.device)
    order = torch.argsort(rank if priority is None else -priority.double(), stable=True)
    cells = torch.floor((position.double() - position.double().min(0).values) / distance).long()
    _, which = torch.unique(cells, dim=0, return_inverse=True)
    first = torch.full((int(which.max()) + 1,), len(position), dtype=torch.long, device=position.device)
    turn = torch.arange(len(position), device=position.device)
    first.scatter_reduce_(0, which[order], turn, reduce="amin")
    keep[order[first]] = True
    return keep
