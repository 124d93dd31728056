"""Members that failed are replaced, and the replacement is an event on record."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .errors import AssimilationError


@dataclass(frozen=True)
class Replacement:
    """Member `member` was replaced; its new state was made from `donor`'s (for what only a donor can give,
    such as particle positions)."""

    member: int
    donor: int


def replace_failed(
    ensemble: Tensor, alive: Tensor, generator: torch.Generator
) -> tuple[Tensor, tuple[Replacement, ...]]:
    """The ensemble with each failed member drawn anew from the survivors' mean and covariance.

    A copy of a survivor would count its information twice and cost a direction; a random combination of the
    survivors' anomalies, `mean + sum_i z_i a_i / sqrt(S - 1)` with standard normal z, does neither. Donors
    are the survivors in turn from a random start.

    Args:
        ensemble: `(N, n)`.
        alive: `(N,)` bool; members that are not finite count as failed whatever it says.

    Raises:
        AssimilationError: fewer than two survivors.
    """
    alive = alive & torch.isfinite(ensemble).all(-1)
    survivors, failed = torch.nonzero(alive).squeeze(-1), torch.nonzero(~alive).squeeze(-1)
    if len(survivors) < 2:
        raise AssimilationError(
            f"only {len(survivors)} of {len(ensemble)} members are alive: an ensemble cannot be rebuilt"
        )
    if not len(failed):
        return ensemble, ()
    living = ensemble[survivors].double()
    mean = living.mean(0)
    shape = (len(failed), len(survivors))
    draw = torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device)
    scale = (len(survivors) - 1) ** -0.5
    fresh = mean + scale * draw.to(living.device) @ (living - mean)
    start = int(torch.randint(len(survivors), (1,), generator=generator, device=generator.device))
    events = tuple(
        Replacement(int(member), int(survivors[(start + k) % len(survivors)]))
        for k, member in enumerate(failed)
    )
    whole = ensemble.clone()
    whole[failed] = fresh.to(ensemble.dtype)
    return whole, events
