"""The finest particles that fit into a number of seconds, found by running one interval of the recording with each.

From coarse to fine, the run of an interval between two frames is timed as the whole run would do it, and counted as
often as that run has such intervals. What the trials themselves take is small beside it (an interval of dozens, of one
batch of members), and is taken off the budget.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

import geometry
from geometry.arguments import checked
from torchsph.simulator.failures import NumericalFailure
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulator import Simulator

from .ensemble.options import EnsembleOptions
from .forecast_skill import starts
from .measurement.prepared import PreparedMeasurement
from .models import Models, make_model
from .runtime.workers import one_thread

# grid spacings, from coarse to fine by a cube root of two: twice the particles each, at half of the last nothing that
# was measured is left to resolve
LADDER = tuple(4.0 * 2.0 ** (-step / 3.0) for step in range(10))


class BudgetTooSmall(ValueError):
    """Even the coarsest particles take longer."""


@dataclass(frozen=True)
class Afforded:
    """Particles that a budget buys.

    Attributes:
        spacing: of the particles, m.
        seconds: that the run with them will take, as foretold.
        budget: s, that was given.
        trials: seconds foretold of each spacing (m) that was tried.
    """

    spacing: float
    seconds: float
    budget: float
    trials: dict[float, float] = field(default_factory=dict)


@checked
def ensemble_spacing(
    measured: geometry.Recording | PreparedMeasurement,
    budget: float,
    *,
    members: int = 16,
    preset: str = "default",
    device: str = "cpu",
    processes: int = 1,
    methods: Sequence[str] = ("ensemble",),
) -> Afforded:
    """Spacing of the members, with which ``run_methods`` takes about ``budget`` seconds on this machine as it is now.

    Args:
        measured: the measurement.
        budget: s.
        members: of the ensemble.
        preset: of the simulator.
        device: of the particles.
        processes: that will share the run.
        methods: that are run.

    Raises:
        BudgetTooSmall: it takes longer with the coarsest particles; the message says how long.
        ValueError: no method with particles is run, or one frame alone was measured.
    """
    began = clock.perf_counter()
    if set(methods) <= {"spline"}:
        raise ValueError("a budget chooses the spacing of particles, and none of the methods has any")
    prepared = PreparedMeasurement.of(measured)
    grid = prepared.recording.grid
    trial = _Trial.of(prepared)
    batch = min(EnsembleOptions().batch, members)

    def predicted(spacing: float) -> float:
        models = Models(prepared, preset, spacing, device)
        single = trial.seconds(models.coarse, 1).whole
        total = trial.splines(processes) + trial.frames * single * len({"free", "sph"} & {"free", *methods})
        if "ensemble" in methods:
            several, control = trial.seconds(models.coarse, batch).whole, trial.seconds(models.fine, 1).whole
            runs = [control] + [several] * math.ceil(members / batch)
            total += trial.frames * (trial.analysis + _longest_share(runs, processes))
        return total

    return _finest(budget, began, [factor * min(grid.spacing) for factor in LADDER], predicted, processes)


@checked
def forecast_spacing(
    recording: geometry.Recording,
    leads: Sequence[float],
    budget: float,
    *,
    every: int = 1,
    preset: str = "default",
    device: str = "cpu",
    processes: int = 1,
) -> Afforded:
    """Spacing with which ``forecast_skill`` takes about ``budget`` seconds on this machine as it is now.

    Args:
        recording: that is forecast.
        leads: s.
        budget: s.
        every: frames from one start to the next.
        preset: of the simulator.
        device: of the particles.
        processes: that will share the starts.

    Raises:
        BudgetTooSmall: it takes longer with the coarsest particles; the message says how long.
    """
    began = clock.perf_counter()
    each = starts(recording, leads, every)
    first = sorted(each)[len(each) // 2]
    velocity = np.where(recording.mask[first], np.nan_to_num(recording.velocity[first]), 0.0).astype(np.float32)
    trial = _Trial(recording, first, torch.from_numpy(velocity), 0.0, 1)
    ahead = sum(recording.time[max(frames.values())] - recording.time[start] for start, frames in each.items())
    step = float(recording.time[first + 1] - recording.time[first])
    shared = math.ceil(len(each) / processes) / len(each)

    def predicted(spacing: float) -> float:
        taken = trial.seconds(make_model(recording, preset=preset, spacing=spacing, device=device), 1)
        return float(shared * (len(each) * taken.setup + ahead / step * taken.steps))

    return _finest(budget, began, [factor * min(recording.grid.spacing) for factor in LADDER], predicted, processes)


@dataclass(frozen=True)
class _Taken:
    """Seconds of one interval: for the start, and for the steps."""

    setup: float
    steps: float

    @property
    def whole(self) -> float:
        return self.setup + self.steps


@dataclass(frozen=True)
class _Trial:
    """An interval that stands for all of a recording.

    Attributes:
        recording: with walls and times.
        first: frame at which the interval begins; it ends with the next.
        velocity: (D, *shape), m/s, at that frame.
        analysis: seconds of a fit of one frame, which is about what an analysis takes.
        groups: of frames that are fitted together.
    """

    recording: geometry.Recording
    first: int
    velocity: Tensor
    analysis: float
    groups: int

    @classmethod
    def of(cls, prepared: PreparedMeasurement) -> _Trial:
        """The interval of the measurement at which the flow is as fast as usual, from the spline there."""
        splines, recording = prepared.splines, prepared.recording
        if recording.frames < 2:
            raise ValueError("a budget is divided by intervals between frames, and there is one frame alone")
        square = np.square(np.nan_to_num(recording.velocity[:-1]) * np.asarray(recording.mask[:-1])[:, None])
        speed = square.reshape(len(square), -1).mean(1)
        usual = [frame for frame in np.argsort(speed) if splines.measures(int(frame))]
        first = int(usual[len(usual) // 2])
        began = clock.perf_counter()
        field = splines.on_grid(splines.fit(first), first)
        # the choice of smoothness, of whose cost the group's other frames have no part, was made on the way
        frames = min(splines.choose_every, recording.frames)
        choosing = clock.perf_counter() - began
        began = clock.perf_counter()
        splines.fit(first)
        plain = clock.perf_counter() - began
        return cls(
            recording, first, torch.from_numpy(field), (choosing + (frames - 1) * plain) / frames, splines.groups
        )

    @property
    def frames(self) -> int:
        return self.recording.frames

    def splines(self, processes: int) -> float:
        """Seconds of the splines of all frames."""
        return math.ceil(self.groups / processes) / self.groups * self.frames * self.analysis

    def seconds(self, model: Simulator, members: int) -> _Taken:
        """What the interval takes with so many members."""
        recording, first = self.recording, self.first
        masks = [
            torch.from_numpy(np.array(recording.mask[frame], bool)).to(model.device) for frame in (first, first + 1)
        ]
        start, end = (float(time) for time in recording.time[first : first + 2])
        began = clock.perf_counter()
        velocity = self.velocity.expand(members, *self.velocity.shape).contiguous().to(model.device)
        going = GridForecast(model, recording.grid, velocity, masks[0], start, Transfer())
        ready = clock.perf_counter()
        going.at(end, masks[1])
        return _Taken(ready - began, clock.perf_counter() - ready)


def _longest_share(runs: Sequence[float], processes: int) -> float:
    """Seconds until all runs are done, the longest first, each by the process that is free first."""
    busy = [0.0] * processes
    for run in sorted(runs, reverse=True):
        busy[busy.index(min(busy))] += run
    return max(busy)


def _finest(
    budget: float, began: float, ladder: Sequence[float], predicted: Callable[[float], float], processes: int
) -> Afforded:
    """The finest spacing of the ladder (m, coarse ones first) whose run fits, with the trials, into the budget (s).

    A run of finer particles takes longer at least as there are more of them: where that alone is too much, it is not
    tried any more.
    """
    trials: dict[float, float] = {}
    fits: float | None = None
    for spacing in ladder:
        left = budget - (clock.perf_counter() - began)
        if fits is not None and trials[fits] * (fits / spacing) ** 2 > left:
            break
        try:
            with one_thread() if processes > 1 else nullcontext():
                trials[spacing] = predicted(spacing)
        except (NumericalFailure, ValueError):  # too coarse for these walls
            continue
        if trials[spacing] > budget - (clock.perf_counter() - began):
            break
        fits = spacing
    if not trials:
        raise ValueError(f"particles of {ladder[-1]:g} to {ladder[0]:g} m do not fit into these walls; give a spacing")
    if fits is None:
        coarsest, seconds = next(iter(trials.items()))
        needed = seconds + clock.perf_counter() - began
        raise BudgetTooSmall(
            f"{budget:g} s are not enough: particles of {1e3 * coarsest:.3g} mm, the coarsest, need about "
            f"{needed:.3g} s on this machine as it is now; give more, fewer members or frames, or a spacing"
        )
    return Afforded(fits, trials[fits], budget, trials)
