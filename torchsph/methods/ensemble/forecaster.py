"""Forecasts of an ensemble of two resolutions: one fine control run, and members that carry what may be wrong with it.

The control carries the estimate; members are needed for their differences alone, which are smoother and may be
simulated with coarser particles (F. Rainwater and B. Hunt, Mon. Wea. Rev. 141 (2013) 3007). Processes under
``torch.distributed`` share the runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

import geometry
from torchsph.simulator.failures import NumericalFailure
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.transfer.pressure_fetching import PressureAverages

from ..runtime.parallel import shared


@dataclass(frozen=True)
class Ensemble:
    """The estimate and the members around it.

    Attributes:
        control: (D, *shape), m/s.
        members: (N, D, *shape), m/s; their mean need not be the control.
        parameters: (N,) of each estimated parameter by its name.
    """

    control: Tensor
    members: Tensor
    parameters: Mapping[str, Tensor] = field(default_factory=dict)

    def centred(self) -> Ensemble:
        """The members moved together so that their mean is the control."""
        return replace(self, members=self.members - self.members.mean(0) + self.control)


@dataclass(frozen=True)
class Forecasts:
    """An ensemble at the times asked for.

    Attributes:
        states: one ensemble per time.
        covered: (*shape) bool at the last time, of the control.
        failed: (N,) bool.
        control_failed: the members' mean then stands for the control.
        steps: of all runs together.
        shock: what the projection had to take from the control's start, relative (``GridForecast.shock``).
        rates: mean du/dt over the interval, m/s^2, NaN where unknown, where they were asked for.
        pressure: (2, *shape), Pa, of the control, averaged over the first and the last half of the interval, up to a
            constant each; NaN where unknown. Where it was asked for.
    """

    states: list[Ensemble]
    covered: Tensor
    failed: Tensor
    control_failed: bool
    steps: int
    shock: float
    rates: Ensemble | None = None
    pressure: Tensor | None = None


class Runs(NamedTuple):
    """What one process hands to the others: the control's run, or those of members that are simulated together.

    Attributes:
        fields: (times, D, *shape) of the control, (times, k, D, *shape) of members, NaN where one failed; with motion
            their rates are the last.
        covered: (*shape), what the control covers at the end.
        shock: of the control.
        pressure: (2, *shape), of the control, with motion.
        steps: that were taken.
    """

    fields: Tensor
    covered: Tensor = torch.empty(0)
    shock: float = 0.0
    pressure: Tensor | None = None
    steps: int = 0


class Forecaster:
    """Runs the control and the members from one analysis to the next.

    Args:
        model: of the control.
        coarse: of the members.
        grid: of the state.
        transfer: how grid forecasts are made.
        batch: members that are simulated together. They share the search of neighbours, whose times decide on the last
            digits of their sums: with the same batches the same bits result, whatever process runs them.
        seed: of the particles.
        motion: hand back rates and the control's pressure as well.
    """

    def __init__(
        self,
        model: Simulator,
        coarse: Simulator,
        grid: geometry.Grid,
        transfer: Transfer,
        *,
        batch: int = 8,
        seed: int = 0,
        motion: bool = False,
    ) -> None:
        if batch < 1:
            raise ValueError(f"a batch needs at least one member, got {batch}")
        self.batch, self.motion = batch, motion
        self.model, self.coarse, self.grid, self.transfer, self.seed = model, coarse, grid, transfer, seed

    def advance(
        self, ensemble: Ensemble, start: float, mask: Tensor, times: Sequence[float], masks: Sequence[Tensor]
    ) -> Forecasts:
        """Forecast from ``start`` (s), where the velocity is known on ``mask``, to ``times``, fetched on ``masks``.

        A failed member holds NaN. Every process gets the whole.
        """
        count, here = len(ensemble.members), (start, mask, times, masks)
        batches = [slice(first, min(first + self.batch, count)) for first in range(0, count, self.batch)]
        # the control is the longest of the runs: the first process has it. Batches of one model share walls and seeding
        (control, covered, shock, pressure, steps), *runs = shared(
            [
                partial(self._control, ensemble, *here),
                *(partial(self._members, ensemble, these, *here) for these in batches),
            ],
            taken_over=self.coarse is self.model,
        )
        fields, steps = torch.cat([run.fields for run in runs], 1), steps + sum(run.steps for run in runs)
        fields, control, rates = self._parted(fields, control, len(times))
        failed = ~torch.isfinite(fields).flatten(2).all(2).all(0)
        lost = not bool(torch.isfinite(control).all())
        if lost:
            if bool(failed.all()):
                raise NumericalFailure(f"the control and all {count} members failed after {start:g} s")
            control = fields[:, ~failed].mean(1)
        states = [Ensemble(control[k], fields[k], ensemble.parameters) for k in range(len(times))]
        return Forecasts(states, covered, failed, lost, steps, shock, rates, pressure)

    def _parted(self, fields: Tensor, control: Tensor, times: int) -> tuple[Tensor, Tensor, Ensemble | None]:
        """What ``_run`` has put behind one another: members (times, N, ...), control (times, ...) and their rates."""
        if not self.motion:
            return fields, control, None
        return fields[:times], control[:times], Ensemble(control[times], fields[times])

    def _members(
        self,
        ensemble: Ensemble,
        these: slice,
        start: float,
        mask: Tensor,
        times: Sequence[float],
        masks: Sequence[Tensor],
    ) -> Runs:
        """Members that are simulated together, NaN where one failed."""
        parameters = {name: row[these] for name, row in ensemble.parameters.items()}
        found, _, failed, _, steps, _ = self._run(
            self.coarse, ensemble.members[these], parameters, start, mask, times, masks
        )
        return Runs(torch.where(failed.reshape(1, -1, *[1] * (found.ndim - 2)), torch.nan, found), steps=steps)

    def _control(
        self, ensemble: Ensemble, start: float, mask: Tensor, times: Sequence[float], masks: Sequence[Tensor]
    ) -> Runs:
        """The control's own run."""
        middle = {name: row.mean()[None] for name, row in ensemble.parameters.items()}
        halves = None
        if self.motion:
            middle_time = 0.5 * (start + times[-1])
            halves = PressureAverages(self.grid, [mask, masks[-1]], [(start, middle_time), (middle_time, times[-1])])
        found, covered, failed, shock, steps, pressure = self._run(
            self.model, ensemble.control[None], middle, start, mask, times, masks, halves
        )
        fields = torch.where(failed[0], torch.nan, found[:, 0])
        return Runs(fields, covered[0], float(shock[0]), None if pressure is None else pressure[0], steps)

    def _run(
        self,
        model: Simulator,
        states: Tensor,
        parameters: Mapping[str, Tensor],
        start: float,
        mask: Tensor,
        times: Sequence[float],
        masks: Sequence[Tensor],
        averages: PressureAverages | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, int, Tensor | None]:
        """Grids (times, k, D, *shape), covered (k, *shape), failed (k,), shocks (k,), steps taken and pressures.

        With motion the rates follow the grids.
        """
        known, motion = mask.to(model.device), self.motion
        going = GridForecast(
            model, self.grid, states.to(model.device), known, start, self.transfer, seed=self.seed, rates=motion
        )
        if averages is not None:
            going.run.observers.append(partial(averages.note, going.run))
        if parameters:
            going.run.change(**{name: row.to(torch.float32) for name, row in parameters.items()})
        found, record = [], going.run.record
        covered = torch.zeros((len(states), *self.grid.shape), dtype=torch.bool)
        try:
            for time, where in zip(times, masks, strict=True):
                value, covered = going.at(time, where.to(model.device))
                found.append(value.cpu().to(torch.float32))
            if self.motion:
                found.append(going.rate().cpu().to(torch.float32))
        except NumericalFailure:  # nobody is left; what was fetched before stays unused as well
            found = [torch.full_like(states, torch.nan)] * (len(times) + self.motion)
        steps, pressure = int(record.steps.sum()), None if averages is None else averages.fields(len(states))
        return torch.stack(found), covered.cpu(), record.failed.cpu(), going.shock, steps, pressure
