"""Members that failed are replaced, and the replacement is an event on record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import AssimilationError


@dataclass(frozen=True)
class Replacement:
    """Member `member` was replaced; its new state was made with the help of `donor` (for what only another
    member can give, such as particle positions)."""

    member: int
    donor: int


@dataclass(frozen=True)
class Repaired:
    """The whole ensemble `(N, n)` and an event per member that was replaced."""

    ensemble: Tensor
    events: tuple[Replacement, ...]


def replace_failed(
    ensemble: Tensor,
    failed: Tensor,
    generator: torch.Generator,
    *,
    fresh: Callable[[int, torch.Generator], Tensor] | None = None,
    share: float = 0.5,
) -> Repaired:
    """The ensemble with each failed member drawn anew from the survivors' mean and covariance.

    A copy of a survivor would count its information twice; a random combination of the survivors' anomalies,
    `mean + sum_i z_i a_i / sqrt(S - 1)` with standard normal z, does not. But it lies in the survivors' span,
    so that members failing again and again use up the ensemble's directions. `fresh` gives new ones: a share
    of the variance then comes from its perturbations, scaled to the survivors' RMS spread.

    Args:
        ensemble: `(N, n)`.
        failed: `(N,)` bool; members that are not finite count as failed whatever it says.
        fresh: `(count, generator) -> (count, n)` perturbations of any size, admissible in the model.
        share: of the variance that is fresh, in [0, 1]; used with `fresh` only.

    Donors are the survivors in turn from a random start.

    Raises:
        AssimilationError: fewer than two survivors.
    """
    if not 0 <= share <= 1:
        raise AssimilationError(f"the fresh share of the variance must lie in [0, 1], got {share}")
    failed = failed.to(ensemble.device) | ~torch.isfinite(ensemble).all(-1)
    survivors, lost = torch.nonzero(~failed).squeeze(-1), torch.nonzero(failed).squeeze(-1)
    if len(survivors) < 2:
        raise AssimilationError(
            f"only {len(survivors)} of {len(ensemble)} members are alive: an ensemble cannot be rebuilt"
        )
    if not len(lost):
        return Repaired(ensemble, ())
    living = ensemble[survivors].double()
    drawn = _combinations(living, len(lost), generator)
    if fresh is not None:
        new = fresh(len(lost), generator).double()
        size = living.var(0).mean().sqrt() / new.square().mean().sqrt()
        drawn = (1 - share) ** 0.5 * drawn + share**0.5 * size * new
    start = int(torch.randint(len(survivors), (1,), generator=generator, device=generator.device))
    events = tuple(
        Replacement(int(member), int(survivors[(start + k) % len(survivors)])) for k, member in enumerate(lost)
    )
    whole = ensemble.clone()
    whole[lost] = (living.mean(0) + drawn).to(ensemble.dtype)
    return Repaired(whole, events)


def _combinations(members: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """`(count, n)` anomalies drawn from the sample covariance of `members (S, n)`."""
    shape = (count, len(members))
    draw = torch.randn(shape, generator=generator, dtype=torch.float64, device=generator.device)
    return (len(members) - 1) ** -0.5 * draw.to(members.device) @ (members - members.mean(0))
