"""Observations of one cycle: values, error variances, places, and why some of them are not used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from .errors import AssimilationError


class Reason(IntEnum):
    """Why an observation was, or was not, used. Stored as uint8 next to the observation."""

    USED = 0
    MISSING = 1  # the value is NaN
    NO_WEIGHT = 2  # the variance is infinite or NaN: the observation says nothing
    NOT_PREDICTED = 3  # at least one member has no (finite) prediction of it
    GROSS_ERROR = 4  # the innovation is larger than the stated errors allow
    OUT_OF_REACH = 5  # farther than the localisation radius from every state variable
    THINNED = 6  # dropped beforehand, in favour of a neighbour with a correlated error
    QUALITY = 7  # dropped beforehand by the measurement's own quality flags
    AMBIGUOUS = 8  # the value has wrapped, and the forecast cannot tell how often


@dataclass(frozen=True)
class Observations:
    """Observations with independent Gaussian errors, in any unit; leading batch dimensions are allowed.

    Attributes:
        value: `(*batch, m)`; NaN marks a missing observation.
        variance: `(*batch, m)` or broadcastable to `value`, in the unit of `value` squared; infinity or NaN
            gives zero weight. It is the variance of ONE observation, whatever its neighbours do.
        position: `(q, D)` with m a multiple of q: observation k lies at `position[k % q]`, so that a
            component-major field of vectors names each place once. Only localised filters need it.
        redundancy: factor >= 1, scalar or `(m,)`, that multiplies the variance in the analysis only. It
            stands for errors that are correlated between neighbours: k observations with one common error
            are worth one, so each is given a k-th of its weight. Innovation statistics and the gross-error
            check keep the bare variance.
        reason: `(*batch, m)` or `(m,)` uint8 `Reason` codes set beforehand; non-zero means not used.

    Raises:
        AssimilationError: shapes that do not fit, or a variance that is zero or negative: the gain of an
            exact observation is singular. `with_floor` gives such observations a smallest error.
    """

    value: Tensor
    variance: Tensor
    position: Tensor | None = None
    redundancy: Tensor | float = 1.0
    reason: Tensor | None = None

    def __post_init__(self) -> None:
        if not self.value.is_floating_point() or self.value.ndim < 1:
            raise AssimilationError("observation values must be a floating-point tensor of shape (*batch, m)")
        for name in ("variance", "reason"):
            part = getattr(self, name)
            if part is not None:
                _check_broadcast(name, part, self.value)
        if bool((self.variance <= 0).any()):
            where = torch.nonzero(self.variance <= 0)[0].tolist()
            raise AssimilationError(
                f"the variance of observation {where} is zero or negative, which makes the gain singular: "
                "give its true error variance, or use Observations.with_floor(...)"
            )
        if bool((torch.as_tensor(self.redundancy) < 1).any()):
            raise AssimilationError("redundancy must be >= 1: correlated errors never add information")
        count = self.value.shape[-1]
        if self.position is not None and (
            self.position.ndim != 2 or (count and (not len(self.position) or count % len(self.position)))
        ):
            raise AssimilationError(
                f"position must be (q, D) with the number of observations {count} a multiple of q, "
                f"got {tuple(self.position.shape)}"
            )

    @classmethod
    def with_floor(cls, value: Tensor, variance: Tensor, floor: float, **others: Any) -> Observations:
        """Observations whose variance is raised to at least `floor` (> 0): the cure for exact ones."""
        if not floor > 0:
            raise AssimilationError(f"the variance floor must be positive, got {floor}")
        return cls(value, variance.clamp(min=floor), **others)

    def __len__(self) -> int:
        return self.value.shape[-1]

    @property
    def places(self) -> Tensor | None:
        """`(m, D)`: the position of every single observation."""
        if self.position is None or not len(self):
            return self.position
        return self.position.repeat(len(self) // len(self.position), 1)

    def codes(self) -> Tensor:
        """`(*batch, m)` uint8 `Reason` codes that follow from the observations alone."""
        code = torch.zeros(self.value.shape, dtype=torch.uint8, device=self.value.device)
        code[~torch.isfinite(self.variance.expand_as(self.value))] = Reason.NO_WEIGHT
        code[~torch.isfinite(self.value)] = Reason.MISSING
        if self.reason is not None:
            earlier = self.reason.to(code).expand_as(code)
            code = torch.where(earlier != 0, earlier, code)
        return code

    def with_redundancy(self, factor: Tensor | float) -> Observations:
        """The same observations with their analysis weight divided by `factor` (see `redundancy`)."""
        return replace(self, redundancy=factor)


def concatenate(sources: Sequence[Observations]) -> Observations:
    """One set of observations from several sources of the same cycle (instruments, grids, components).

    Positions are kept where every source has them; batch dimensions must agree.
    """
    if not sources:
        raise AssimilationError("there are no observations to concatenate")
    places = [places for part in sources if (places := part.places) is not None]
    return Observations(
        value=torch.cat([part.value for part in sources], -1),
        variance=torch.cat([part.variance.expand_as(part.value) for part in sources], -1),
        position=torch.cat(places) if len(places) == len(sources) else None,
        redundancy=torch.cat(
            [torch.as_tensor(part.redundancy, device=part.value.device).expand(len(part)) for part in sources]
        ),
        reason=torch.cat([part.codes() for part in sources], -1),
    )


@dataclass(frozen=True)
class Screened:
    """What an analysis uses of the observations; every tensor is `(*batch, m)`, float64.

    `innovation` (value minus mean prediction) and `weight` (1 / (variance redundancy)) are zero where the
    observation is not used; `predicted_variance` is the ensemble's; `variance` is the bare error variance.
    """

    innovation: Tensor
    weight: Tensor
    predicted_variance: Tensor
    variance: Tensor
    reason: Tensor

    @property
    def used(self) -> Tensor:
        """`(*batch, m)` bool."""
        return self.reason == Reason.USED


def screen(
    observations: Observations, predicted_mean: Tensor, predicted_variance: Tensor, limit: float | None
) -> Screened:
    """Innovations, weights and reason codes of one cycle.

    The gross-error check rejects `d^2 > limit^2 (variance of the prediction + variance of the observation)`
    (e.g. Daley 1991, Atmospheric Data Analysis, section 4.7); `limit=None` switches it off.
    """
    reason = observations.codes()
    value = observations.value.double()
    variance = observations.variance.double().expand_as(value)
    unpredicted = ~(torch.isfinite(predicted_mean) & torch.isfinite(predicted_variance))
    reason = torch.where((reason == 0) & unpredicted, int(Reason.NOT_PREDICTED), reason)
    innovation = value - predicted_mean
    if limit is not None:
        gross = innovation**2 > limit**2 * (predicted_variance + variance)
        reason = torch.where((reason == 0) & gross, int(Reason.GROSS_ERROR), reason)
    used = reason == 0
    redundancy = torch.as_tensor(observations.redundancy, dtype=torch.float64, device=value.device)
    zero = torch.zeros((), dtype=torch.float64, device=value.device)
    return Screened(
        innovation=torch.where(used, innovation, zero),
        weight=torch.where(used, 1 / (variance * redundancy), zero),
        predicted_variance=predicted_variance,
        variance=variance,
        reason=reason.to(torch.uint8),
    )


def count_reasons(reason: Tensor) -> dict[str, int]:
    """Number of observations per reason, by its lower-case name; absent reasons are left out."""
    numbers = torch.bincount(reason.flatten().long(), minlength=len(Reason)).tolist()
    return {Reason(code).name.lower(): number for code, number in enumerate(numbers) if number}


def _check_broadcast(name: str, part: Tensor, value: Tensor) -> None:
    # by hand: torch.broadcast_shapes imports a computer algebra system, which takes a second of every process
    along = zip(reversed(part.shape), reversed(value.shape), strict=False)
    if part.ndim > value.ndim or not all(own in (1, wanted) for own, wanted in along):
        raise AssimilationError(
            f"{name} of shape {tuple(part.shape)} does not fit the values' shape {tuple(value.shape)}"
        )
