"""Analyses with their members and accelerations, one frame after another, to whoever looks on.

An analysis knows its velocity; pressure and force also want du/dt. Differences of analyses 10 ms apart take the noise
of both, and every increment, for acceleration. The forecasts know better: over the interval before a frame and over the
one after it each member has a mean du/dt of its own (`GridForecast.rate`), and their mean is du/dt at the frame. Where
a valve opens or closes in one of the two intervals the other one alone counts: accelerations and the pressure jump
there.

A frame is therefore handed on when the forecast from it is done; two frames are held at a time, whatever the length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import geometry

from ..runtime.parallel import is_lead
from .amplitude import Amplitude
from .resolution import Resolution, seen_again

__all__ = ["FrameObserver", "MemberFrame", "MemberFrames", "at_frame"]

Array = NDArray[np.floating]


@dataclass(frozen=True)
class MemberFrame:
    """One frame of the analyses.

    Attributes:
        frame: its number.
        field: (D, *shape), m/s, the estimate, 0 outside the mask.
        members: (N, D, *shape), m/s, around it: its error is as large as they lie apart.
        rate: (D, *shape), m/s^2, du/dt of the estimate; 0 where nothing is known of it.
        member_rates: (N, D, *shape), m/s^2, of the members.
        pressure: (*shape), Pa, the simulator's own, of mean 0 over the mask; NaN where no particle came by; None where
            nobody has asked for it.
        coarser: (D, *shape), m/s, the estimate as the measurement's kernel would show it once more (``Resolution``);
            None where no kernel is known.
        coarser_rate: (D, *shape), m/s^2, its du/dt, or None.
    """

    frame: int
    field: Array
    members: Array
    rate: Array
    member_rates: Array
    pressure: Array | None
    coarser: Array | None = None
    coarser_rate: Array | None = None


class FrameObserver(Protocol):
    """What is done with every frame."""

    def take(self, frame: MemberFrame) -> None:
        """The next frame; after a restart those since the last checkpoint come again."""

    def state(self) -> dict[str, Any]:
        """What a checkpoint has to hold, as tensors and plain values."""

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""


class MemberFrames:
    """Puts frames together from what the cycle has, and hands them on.

    Args:
        recording: the measurement, whose masks, times and valves are those of the analyses.
        observers: what is done with each frame, in this order.
        amplitude: what members are off by as a whole; None: nothing.
        resolution: what shows an estimate once more; None: no kernel is known.
    """

    def __init__(
        self,
        recording: geometry.Recording,
        observers: Sequence[FrameObserver],
        amplitude: Amplitude | None = None,
        resolution: Resolution | None = None,
    ) -> None:
        self.recording, self.observers = recording, list(observers)
        self.amplitude, self.resolution = amplitude, resolution
        times = np.unique(recording.valve_intervals_or_derived()[:, 1:])
        self._events = times[np.isfinite(times)]
        self._before: dict[str, Tensor] | None = None
        self._pending: dict[str, Tensor] | None = None
        self._frame = -1

    def analysed(self, frame: int, field: Tensor, members: Tensor) -> None:
        """The analysis of a frame.

        Args:
            frame: its number.
            field: (D, *shape), m/s, the estimate as it is given out.
            members: (N, D, *shape), m/s, of the ensemble that goes on from it; their mean need not be the estimate.
        """
        mask = torch.from_numpy(np.array(self.recording.mask[frame], bool))
        around = field + members - members.mean(0)
        if self.amplitude is not None:
            around = around + self.amplitude.of_fields(field, frame)
        around = torch.where(mask, around, 0.0).to(torch.float32)
        self._frame, self._pending = frame, {"field": field, "members": around}

    def forecast(self, rate: Tensor, member_rates: Tensor, failed: Tensor, pressure: Tensor) -> None:
        """The forecast from the last frame analysed, which can be handed on now.

        Args:
            rate: (D, *shape), m/s^2, mean du/dt of the estimate over the interval, NaN where unknown.
            member_rates: (N, D, *shape), m/s^2, of the members.
            failed: (N,) bool, members that count for nothing here.
            pressure: (2, *shape), Pa, averages over both halves of the interval, up to a constant each.
        """
        rates = self._of_all(rate, member_rates, failed)
        ends = [{**rates, "pressure": half - half.nanmean()} for half in pressure]
        self._hand_on(ends[0])
        self._before = ends[1]

    def finish(self) -> None:
        """There is no further frame: hand on the last one."""
        self._hand_on(None)

    def state(self) -> dict[str, Any]:
        """What a checkpoint has to hold."""
        return {
            "frame": self._frame,
            "before": self._before,
            "pending": self._pending,
            "observers": [observer.state() for observer in self.observers],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self._frame, self._before, self._pending = state["frame"], state["before"], state["pending"]
        for observer, kept in zip(self.observers, state["observers"], strict=True) if is_lead() else ():
            observer.restore(kept)

    def _of_all(self, rate: Tensor, member_rates: Tensor, failed: Tensor) -> dict[str, Tensor]:
        """Rates of the estimate, and of the members around it; one that has failed has that of the estimate."""
        mean = member_rates[~failed].mean(0) if bool((~failed).any()) else rate
        own = mean if not bool(torch.isfinite(rate).any()) else rate
        apart = torch.where(failed.reshape(-1, *[1] * mean.ndim), 0.0, member_rates - mean)
        if self.amplitude is not None:
            apart = apart + self.amplitude.of_rates(own)
        return {"rate": own, "member_rates": own + apart}

    def _hand_on(self, after: dict[str, Tensor] | None) -> None:
        frame, pending, before = self._frame, self._pending, self._before
        if pending is None:
            raise ValueError("MemberFrames has no analysis to hand on: call analysed() first")
        weights = self._weights(frame, before is not None, after is not None)
        shape = {"rate": pending["field"].shape, "member_rates": pending["members"].shape}
        shape["pressure"] = pending["field"].shape[1:]
        both: dict[str, Array] = {}
        for name, size in shape.items():
            nothing = torch.full(size, torch.nan)
            sides = [nothing if side is None else side[name] for side in (before, after)]
            both[name] = at_frame(sides[0], sides[1], weights).numpy()
        field, rate = pending["field"].numpy(), np.nan_to_num(both["rate"])
        made = MemberFrame(
            frame,
            field,
            pending["members"].numpy(),
            rate,
            np.nan_to_num(both["member_rates"]),
            without_mean(both["pressure"], np.asarray(self.recording.mask[frame], bool)),
            *seen_again(self.resolution, field, rate, frame),
        )
        for observer in self.observers if is_lead() else ():
            observer.take(made)
        self._pending = None

    def _weights(self, frame: int, before: bool, after: bool) -> tuple[float, float]:
        """Of the intervals before and after a frame: alike, but not across a valve's event where the other has none."""
        time = self.recording.time
        crossed = [
            present and bool(((self._events > begin) & (self._events < end)).any())
            for present, begin, end in (
                (before, time[max(frame - 1, 0)], time[frame]),
                (after, time[frame], time[min(frame + 1, len(time) - 1)]),
            )
        ]
        if before and after and crossed[0] != crossed[1]:
            return (0.0, 1.0) if crossed[0] else (1.0, 0.0)
        return (0.5, 0.5)


def at_frame(before: Tensor, after: Tensor, weights: tuple[float, float]) -> Tensor:
    """The weighted mean of two tensors where both are known, else the one that is; NaN where neither is."""
    mean = weights[0] * torch.nan_to_num(before) + weights[1] * torch.nan_to_num(after)
    return torch.where(torch.isnan(before), after, torch.where(torch.isnan(after), before, mean))


def without_mean(pressure: Array, mask: NDArray[np.bool_]) -> Array:
    """A pressure `(*shape)`, Pa, less its mean over the known nodes of the mask; NaN outside."""
    known = mask & np.isfinite(pressure)
    mean = float(pressure[known].mean(dtype=np.float64)) if known.any() else 0.0
    return np.where(known, pressure - mean, np.nan).astype(np.float32)
