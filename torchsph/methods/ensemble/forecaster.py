"""Forecasts of an ensemble of two resolutions: one fine control run, and members that carry what may be wrong with it.

The control carries the estimate; members are needed for their differences alone, which are smoother and may be
simulated with coarser particles (F. Rainwater and B. Hunt, Mon. Wea. Rev. 141 (2013) 3007). Processes under
``torch.distributed`` share the runs and gather the grids.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor

import geometry
from torchsph.assimilation import gather_members
from torchsph.simulator.failures import NumericalFailure
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.transfer.pressure_fetching import PressureAverages


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
        steps: of all runs of this process together.
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


class Control(NamedTuple):
    """The control's run: (times, D, *shape), NaN where it failed; (*shape) what it covers at the end; its shock.

    With motion its rate is the last of the fields, and ``pressure`` (2, *shape) is there.
    """

    fields: Tensor
    covered: Tensor
    shock: float
    pressure: Tensor | None = None


def shares(members: int, control_cost: float, processes: int, batch: int = 1) -> list[tuple[bool, slice]]:
    """Who runs what: for each process whether it runs the control, and its slice of the members.

    The control, which costs as much as ``control_cost`` members, belongs to the first process; the members follow in
    order and in whole batches, so that all processes have about the same to do.
    """
    batches, cost = -(-members // batch), control_cost / batch
    fair = (batches + cost) / processes
    ends = [min(batches, max(0, round((rank + 1) * fair - cost))) for rank in range(processes)]
    ends[-1] = batches
    bounds = [min(members, batch * end) for end in [0, *ends]]
    return [(rank == 0, slice(bounds[rank], bounds[rank + 1])) for rank in range(processes)]


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
        ratio = coarse.scene.spacing / model.scene.spacing
        self.control_cost = ratio ** (grid.dimension + 1)  # so many more particles, and so much shorter steps

    def advance(
        self, ensemble: Ensemble, start: float, mask: Tensor, times: Sequence[float], masks: Sequence[Tensor]
    ) -> Forecasts:
        """Forecast from ``start`` (s), where the velocity is known on ``mask``, to ``times``, fetched on ``masks``.

        A failed member holds NaN. Every process gets the whole.
        """
        count = len(ensemble.members)
        rank, processes = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        todo = shares(count, self.control_cost, processes, self.batch)
        lead, mine = todo[rank]
        here = (start, mask, times, masks)
        run = self._members(ensemble, mine, *here)
        own, steps = None, run[1]
        if lead:
            own, more = self._control(ensemble, *here)
            steps += more
        fields, (control, covered, shock, pressure) = self._gathered(ensemble, run[0], own, todo)
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
        mine: slice,
        start: float,
        mask: Tensor,
        times: Sequence[float],
        masks: Sequence[Tensor],
    ) -> tuple[Tensor, int]:
        """(times, k, D, *shape) of this process's members, NaN where one failed; and the steps taken."""
        done = [ensemble.members.new_zeros((len(times) + self.motion, 0, *ensemble.control.shape))]
        total = 0
        for first in range(mine.start, mine.stop, self.batch):
            these = slice(first, min(first + self.batch, mine.stop))
            parameters = {name: row[these] for name, row in ensemble.parameters.items()}
            found, _, failed, _, steps, _ = self._run(
                self.coarse, ensemble.members[these], parameters, start, mask, times, masks
            )
            done.append(torch.where(failed.reshape(1, -1, *[1] * (found.ndim - 2)), torch.nan, found))
            total += steps
        return torch.cat(done, 1), total

    def _control(
        self, ensemble: Ensemble, start: float, mask: Tensor, times: Sequence[float], masks: Sequence[Tensor]
    ) -> tuple[Control, int]:
        """The control's own run, and its steps."""
        middle = {name: row.mean()[None] for name, row in ensemble.parameters.items()}
        halves = None
        if self.motion:
            middle_time = 0.5 * (start + times[-1])
            halves = PressureAverages(self.grid, [mask, masks[-1]], [(start, middle_time), (middle_time, times[-1])])
        found, covered, failed, shock, steps, pressure = self._run(
            self.model, ensemble.control[None], middle, start, mask, times, masks, halves
        )
        fields = torch.where(failed[0], torch.nan, found[:, 0])
        return Control(fields, covered[0], float(shock[0]), None if pressure is None else pressure[0]), steps

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

    def _gathered(
        self, ensemble: Ensemble, members: Tensor, control: Control | None, todo: list[tuple[bool, slice]]
    ) -> tuple[Tensor, Control]:
        """All members (times, N, ...) and the control's run, the same in every process.

        Args:
            ensemble: before the forecast.
            members: (times, k, ...) of this process.
            control: in the process that ran it.
            todo: who ran what (``shares``).
        """
        if len(todo) == 1 and control is not None:
            return members, control
        counts = [part.stop - part.start for _, part in todo]
        everyone = gather_members(members.transpose(0, 1), counts).transpose(0, 1)
        shape = (len(members), *ensemble.control.shape)
        nodes, halves = ensemble.control[0].numel(), 2 if self.motion else 0
        if control is None:
            control = Control(torch.empty(shape), torch.empty(shape[2:], dtype=torch.bool), 0.0)
        field, covered, shock, pressure = control
        if pressure is None:
            pressure = torch.empty((halves, *shape[2:]))
        parts = [field.flatten(), covered.flatten(), pressure.flatten(), torch.tensor([shock], dtype=torch.float64)]
        packed = torch.cat([part.double() for part in parts])
        dist.broadcast(packed, 0)
        size = field.numel()
        field, where = packed[:size].to(field).reshape(shape), packed[size : size + nodes].reshape(shape[2:]) > 0.5
        pressure = packed[size + nodes : -1].to(pressure).reshape(halves, *shape[2:])
        return everyone, Control(field, where, float(packed[-1]), pressure if self.motion else None)
