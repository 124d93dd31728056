"""One cycle of the ensemble: forecast, observe, analyse; and everything that has to survive a restart."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

import geometry
from torchsph.assimilation import Filter
from torchsph.evaluation.frames import SAME_TIME
from torchsph.simulator.failures import NumericalFailure

from ..measurement.observation_batch import Part, gathered
from ..measurement.observation_operator import Measurement
from ..members.amplitude import Amplitude
from ..members.frames import FrameObserver, MemberFrames
from ..members.resolution import Resolution
from ..runtime.parallel import forked, from_last, is_last, shared
from .analyser import Analyser
from .analyses import Analyses
from .forecast_spread import ForecastSpread
from .forecaster import Ensemble, Forecaster
from .options import EnsembleOptions
from .quality import analysed_codes, first_codes


class Cycle:
    """The ensemble on its way through the frames of the first measurement.

    Args:
        measurements: the first one gives the state's grid, mask, walls and times of analysis.
        forecaster: runs the members.
        filter_: any filter of ``assimilation``.
        options: of the cycle.
        members: N.
        truth: for the record's scores alone; it never enters an analysis.
        seed: of everything random.
        observers: what is done with every frame and its members; none: nothing more is computed or held.

    Attributes:
        alive: members that lived through the last forecast.

    Raises:
        ValueError: more members are to be alive than there are.
    """

    def __init__(
        self,
        measurements: Sequence[Measurement],
        forecaster: Forecaster,
        filter_: Filter,
        options: EnsembleOptions,
        *,
        members: int,
        truth: geometry.Recording | None = None,
        seed: int = 0,
        observers: Sequence[FrameObserver] = (),
    ) -> None:
        self.measurements, self.forecaster = list(measurements), forecaster
        self.options, self.count = options, members
        if members < (options.minimum_members or 0):
            raise ValueError(f"minimum_members is {options.minimum_members}, but there are only {members} members")
        self.measured, self.grid = measurements[0].recording, measurements[0].grid
        self.splines = measurements[0].prepared.splines
        self.generator = torch.Generator().manual_seed(seed)
        prepared = measurements[0].prepared
        self.analyses = Analyses(self.measured, options.lag, prepared.balance)
        self.analyser = Analyser(
            self.measurements, filter_, options, self.generator, self.analyses, truth=truth, seed=seed
        )
        self.forecast_spread = ForecastSpread(measurements[0], options, members, self.generator, self.analyses)
        self.member_frames = None
        if observers:
            amplitude = Amplitude(prepared.balance, prepared.amplitude_error, members, seed)
            resolution = Resolution.of(self.measured, prepared.balance, measurements[0].kernel)
            self.member_frames = MemberFrames(self.measured, observers, amplitude, resolution)
        self._ensemble: Ensemble | None = None
        self.alive = members

    @property
    def ensemble(self) -> Ensemble:
        """The last analysis, from which the next forecast starts."""
        if self._ensemble is None:
            raise RuntimeError("the cycle has not begun: call begin() or restore() first")
        return self._ensemble

    @property
    def done(self) -> int:
        """Frames that have their analysis."""
        return len(self.analyses.fields)

    def mask(self, frame: int) -> Tensor:
        """(*shape) bool, of a frame."""
        return torch.from_numpy(np.array(self.measured.mask[frame], bool))

    def begin(self) -> None:
        """The first frame: its spline and draws from the spline's posterior; walls alone where it measured nothing."""
        mask, generator = self.mask(0), forked(self.generator)
        [(control, draws)] = shared([partial(self._first, generator)])
        parameters = {one.parameter.name: one.draw(self.count, self.generator) for one in self.options.estimated}
        self._ensemble = Ensemble(control, control + draws, parameters).centred()
        sigma = torch.where(mask, self.ensemble.members.std(0), 0.0)
        self._add(control, sigma, first_codes(self.measurements[0], mask), 0)

    def _add(self, control: Tensor, sigma: Tensor, quality: Tensor, missing: int) -> None:
        """The next frame's analysis (``Analyses.add``), and its members to those who look on."""
        self.analyses.add(self.ensemble, control, sigma, quality, missing)
        if self.member_frames is not None:
            self.member_frames.analysed(self.done - 1, self.analyses.fields[-1], self.ensemble.members)
            if self.done == self.measured.frames:
                self.member_frames.finish()

    def _first(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """The first control (D, *shape), and deviations of the members (N, D, *shape)."""
        if self.splines.measures(0):
            fitted = self.splines.fit(0, uncertainty=True)
            control = torch.from_numpy(self.splines.on_grid(fitted, 0))
            return control, self.splines.draws(fitted, 0, self.count, generator).to(control.dtype)
        control = torch.zeros((self.grid.dimension, *self.grid.shape))
        return control, self.forecast_spread.perturbations(0, self.forecast_spread.reference_speed, generator)

    def step(self, frame: int) -> None:
        """From the analysis of the frame before to that of ``frame``."""
        before, now = (float(t) for t in self.measured.time[frame - 1 : frame + 1])
        early, late = self.mask(frame - 1), self.mask(frame)
        seen = [
            (measurement, measurement.see(number), float(measurement.recording.time[number]))
            for measurement in self.measurements
            for number in measurement.frames_within(before, now)
        ]
        times = sorted({time for _, _, time in seen if time < now - SAME_TIME}) + [now]
        masks = [early | late] * (len(times) - 1) + [late]
        generator, noise = forked(self.generator), None
        if is_last() and self.options.model_error > 0:
            noise = self.forecast_spread.perturbations(frame, 1.0, generator)
        forecasts = self.forecaster.advance(self.ensemble, before, early, times, masks)
        self._count_alive(forecasts.failed, now)
        self.analyses.shocks.append(forecasts.shock)
        if self.member_frames is not None and forecasts.rates is not None and forecasts.pressure is not None:
            rates = forecasts.rates
            self.member_frames.forecast(rates.control, rates.members, forecasts.failed, forecasts.pressure)
        states = self.forecast_spread.prepared(forecasts, from_last(noise), frame, self.analyser.spread_match.factor)
        missing = int((late & ~forecasts.covered).sum())
        parts = [Part(measurement, what, _nearest(times, time)) for measurement, what, time in seen]
        members = [state.members for state in states]
        batch = gathered(parts, members, masks, self.measurements, self.analyser.scale)
        if batch is None:  # nothing was measured: the forecast is the analysis
            self.analyser.coast()
            self.analyses.happened(frame, coasted=True)
            self._ensemble = states[-1]
            sigma, reason = torch.where(late, self.ensemble.members.std(0), 0.0), torch.empty(0)
        else:
            self._ensemble, sigma = self.analyser.analyse(states[-1], batch, frame)
            reason = self.analyser.reason
        quality = analysed_codes([] if batch is None else batch.parts, reason, late, forecasts.covered, self.grid)
        self._add(torch.where(late, self.ensemble.control, 0.0), sigma, quality, missing)

    def _count_alive(self, failed: Tensor, time: float) -> None:
        """Count the members that are not among the failed (N,); refuse to go on where too few are left."""
        self.alive = self.count - int(failed.sum())
        least = self.options.minimum_members
        if least is not None and self.alive < least:
            raise NumericalFailure(
                f"{self.alive} of {self.count} members lived through the forecast to {time:g} s, fewer than the "
                f"{least} of minimum_members; try a larger spacing, or look at the walls and valves around that time"
            )

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on, as tensors and plain values."""
        return {
            "ensemble": {
                "control": self.ensemble.control,
                "members": self.ensemble.members,
                "parameters": dict(self.ensemble.parameters),
            },
            "generator": self.generator.get_state(),
            "analyser": self.analyser.state(),
            "analyses": self.analyses.state(),
            **({} if self.member_frames is None else {"member frames": self.member_frames.state()}),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self._ensemble = Ensemble(**state["ensemble"])
        self.generator.set_state(state["generator"])
        self.analyser.restore(state["analyser"])
        self.analyses.restore(state["analyses"])
        if self.member_frames is not None:
            if "member frames" not in state:
                raise ValueError(
                    "the checkpoint holds no members; start anew, or go on without what is read out of them "
                    "(--no-quantities, and no --keep-members)"
                )
            self.member_frames.restore(state["member frames"])


def _nearest(times: list[float], time: float) -> int:
    return int(np.abs(np.array(times) - time).argmin())
