"""What a quantity may be, from members: mean, deviation and the band from 5 to 95 %.

Members are fields that the truth might be (an ensemble around its control, draws from a spline's posterior). A quantity
is computed on each of them and only then summarised: of the mean field everything quadratic comes out too small.

An ensemble around a control that is not its mean gives control + (x_m - mean): `around`. With few members the 5 and
95 % quantiles of a sample lie too far inside; `summary` therefore takes those of Student's distribution with the
sample's mean and deviation, which hold the right share for a normal quantity at any number of members (Wilks
2011): mean +- t(.95, M - 1) s sqrt(1 + 1 / M).

Members agree about what none of them shows: what is finer than the measurement's resolution. Two numbers say how much
of a quantity lies there, and the larger counts as a deviation that all members share (`unresolved`): what the members'
variance adds to a quadratic of their mean, a correction that is as uncertain as it is large; and what the measurement's
kernel takes from the quantity when the estimate is put through it once more (after Roache 1994, who judges a solution
by what it loses on a coarser grid).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

__all__ = ["RunningMoments", "Summary", "around", "coverage", "summary", "unresolved"]

Array = NDArray[np.float64]

BAND = (0.05, 0.95)


class Summary(NamedTuple):
    """Mean, standard deviation, and the ends of the band that holds nine of ten, each of the quantity's own shape."""

    mean: Array
    deviation: Array
    low: Array
    high: Array


def summary(values: ArrayLike, shared: ArrayLike = 0.0) -> Summary:
    """Summary over the first axis of `values` `(M, ...)`; nan where a member has no value.

    Args:
        values: of each member.
        shared: `(...)`, a deviation of all members together, beside that among them (`unresolved`).

    Raises:
        ValueError: there are fewer than two members.
    """
    members = np.asarray(values, np.float64)
    count = len(members)
    if count < 2:
        raise ValueError(f"summary: a spread needs at least 2 members, not {count}")
    mean, deviation = members.mean(0), np.hypot(members.std(0, ddof=1), np.asarray(shared, np.float64))
    reach = stdtrit(count - 1, BAND[1]) * np.sqrt(1 + 1 / count) * deviation
    return Summary(mean, deviation, mean - reach, mean + reach)


def unresolved(estimate: ArrayLike, members: ArrayLike, coarser: ArrayLike | None = None) -> Array:
    """How much of a quantity lies at scales that estimate and members lack, `(...)`, in its own unit.

    Args:
        estimate: the quantity of the estimate, `(...)`.
        members: of each member around it, `(M, ...)`.
        coarser: of the estimate put through the measurement's kernel once more, `(...)`; None where none is known.
    """
    alone = np.asarray(estimate, np.float64)
    added = np.abs(np.asarray(members, np.float64).mean(0) - alone)
    return added if coarser is None else np.maximum(added, np.abs(alone - np.asarray(coarser, np.float64)))


def around(control: ArrayLike, members: ArrayLike, scale: ArrayLike = 1.0) -> Array:
    """Members `(M, ...)` moved from around their own mean to around `control` `(...)`, anomalies times `scale`."""
    fields = np.asarray(members, np.float64)
    return np.asarray(control, np.float64) + np.asarray(scale, np.float64) * (fields - fields.mean(0))


def coverage(found: Summary, truth: ArrayLike) -> float:
    """Share of true values inside the band; entries without a value do not count."""
    true = np.asarray(truth, np.float64)
    known = np.isfinite(true) & np.isfinite(found.low) & np.isfinite(found.high)
    return float(((true >= found.low) & (true <= found.high))[known].mean()) if known.any() else float("nan")


class RunningMoments:
    """Mean and deviation of fields that are too many to hold, one at a time (Welford 1962)."""

    def __init__(self) -> None:
        self.count = 0
        self._mean: Array | None = None
        self._square: Array | None = None

    def add(self, field: ArrayLike) -> None:
        """Take one more member's field; all have one shape."""
        value = np.asarray(field, np.float64)
        if self._mean is None or self._square is None:
            self._mean, self._square = np.zeros_like(value), np.zeros_like(value)
        self.count += 1
        step = value - self._mean
        self._mean = self._mean + step / self.count
        self._square = self._square + step * (value - self._mean)

    def extend(self, fields: Iterable[ArrayLike]) -> RunningMoments:
        """Take many, one after the other."""
        for field in fields:
            self.add(field)
        return self

    @property
    def mean(self) -> Array:
        """Mean of the fields so far."""
        if self._mean is None:
            raise ValueError("RunningMoments: no field was added")
        return self._mean

    @property
    def deviation(self) -> Array:
        """Standard deviation of the fields so far."""
        if self._square is None or self.count < 2:
            raise ValueError(f"RunningMoments: a deviation needs at least 2 fields, not {self.count}")
        return np.sqrt(self._square / (self.count - 1))
