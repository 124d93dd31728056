"""The analysis of one cycle: a spline of the innovations and a filter, each followed as far as it has proved right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

import geometry
from torchsph.assimilation import (
    Analysis,
    Augmentation,
    ErrorScale,
    Filter,
    FilterRecord,
    LearnedGain,
    Reason,
    SpreadMatch,
)
from torchsph.evaluation.frames import frame_at

from ..measurement.observation_batch import ObservationBatch, error_groups, regions_of
from ..measurement.observation_operator import Measurement
from ..runtime.parallel import forked, shared_pair
from .analyses import Analyses
from .forecaster import Ensemble
from .innovation_spline import InnovationSpline
from .lagged import Lagged
from .options import EnsembleOptions

# draws from the ensemble whose splines tell how large its spread is: each costs a thirtieth of an analysis
_DRAWS = 3


class Analyser:
    """Turns forecasts and observations into analyses, and learns from each how far to follow the next.

    Args:
        measurements: the first one gives the state's grid, mask and walls.
        filter_: any filter of ``assimilation``.
        options: of the cycle.
        generator: of everything random; shared with the cycle.
        analyses: earlier ones, which later data may move.
        truth: for the record's scores alone; it never enters an analysis.
        seed: of the ties in the record's rank histogram.

    Attributes:
        last_increments: (J, D, *shape), m/s, of the last analysis, before they were weighted; None without one.
        reason: (m,) ``Reason`` codes of the last analysis's observations.
    """

    last_increments: Tensor | None
    reason: Tensor

    def __init__(
        self,
        measurements: Sequence[Measurement],
        filter_: Filter,
        options: EnsembleOptions,
        generator: torch.Generator,
        analyses: Analyses,
        *,
        truth: geometry.Recording | None = None,
        seed: int = 0,
    ) -> None:
        self.splines = measurements[0].prepared.splines
        self.measured, self.grid = measurements[0].recording, measurements[0].grid
        self.nodes = self.grid.nodes()
        self.filter, self.options, self.generator, self.truth = filter_, options, generator, truth
        self.analyses = analyses
        self.augmentation = Augmentation(tuple(one.parameter for one in options.estimated))
        self.gain = LearnedGain(len(options.increments), self.grid.dimension, memory=options.memory)
        self.spread_match = SpreadMatch(averaged=options.memory)
        self.scale = ErrorScale(error_groups(measurements)[-1], memory=options.memory)
        self.record = FilterRecord(seed=seed)
        self.spline = InnovationSpline(self.splines, options.choose_every)
        self.last_increments = None

    def analyse(self, state: Ensemble, batch: ObservationBatch, frame: int) -> tuple[Ensemble, Tensor]:
        """The analysed ensemble, and the deviation (D, *shape), m/s, that is claimed of its control."""
        mask = batch.masks[-1]
        inside = torch.nonzero(mask.flatten()).squeeze(1)
        forecast = state.members.flatten(2)[:, :, inside].flatten(1)
        size, positions = forecast.shape[1], self.nodes[inside]
        joint = forecast
        if state.parameters:
            joint = self.augmentation.join(forecast, state.parameters)
            positions = self.augmentation.positions(positions, size)
        screened = self.filter.screen(joint, batch.members, batch.observations)
        weight = torch.where(screened.used, 1.0 / screened.variance, 0.0)
        if self.last_increments is not None:
            self.gain.learn(batch.predicted(self.last_increments), screened.innovation, weight)
        drawn = self._drawn(batch)
        (found, choice), (analysis, regions, earlier) = shared_pair(
            partial(self._splines, torch.cat([screened.innovation[None], drawn]), weight, batch, frame),
            partial(self._filtered, joint, batch, positions, state.control, frame, inside, forked(self.generator)),
        )
        self.analyses.take(earlier)
        self.spline.restore(choice)
        batch = replace(batch, regions=regions)
        self._record(analysis, batch, forecast, inside, frame)
        increments = self._increments(analysis, found, inside, state.control, mask)
        self.last_increments = increments
        change = torch.einsum("j,jd...->d...", self.gain.weight.to(torch.float32), increments)
        self._match_spread(increments, batch, weight > 0, drawn, found)
        self.scale.learn(analysis, batch.observations, batch.group)
        return self._ensemble(state, analysis, forecast, change, mask, inside)

    def coast(self) -> None:
        """Nothing was measured: the next analysis has no increments to learn from."""
        self.last_increments = None

    def state(self) -> dict[str, Any]:
        """What a checkpoint has to hold."""
        learned = {name: getattr(self, name).state() for name in self._LEARNED}
        return {**learned, "last_increments": self.last_increments}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        for name in self._LEARNED:
            getattr(self, name).restore(state[name])
        self.last_increments = state["last_increments"]

    _LEARNED = ("gain", "spread_match", "scale", "record", "spline")

    def _splines(
        self, values: Tensor, weight: Tensor, batch: ObservationBatch, frame: int
    ) -> tuple[Tensor, dict[str, Any] | None]:
        """The splines (k, D, *shape) of numbers (k, m), k = 0 where none are used, and what is remembered of them."""
        if "spline" not in self.options.increments:
            return torch.zeros((0, self.grid.dimension, *self.grid.shape)), None
        return self.spline.of(values, weight, batch, frame), self.spline.state()

    def _filtered(
        self,
        joint: Tensor,
        batch: ObservationBatch,
        positions: Tensor,
        control: Tensor,
        frame: int,
        inside: Tensor,
        generator: torch.Generator,
    ) -> tuple[Analysis, dict[str, Tensor], list[Lagged]]:
        """The filter's analysis, without its map of the members, which is large and has served; regions; the past."""
        analysis = self.filter.analyse(
            joint, batch.members, batch.observations, state_positions=positions, generator=generator
        )
        earlier = self.analyses.improved(analysis, inside, self.grid.dimension * len(inside))
        motion = self.splines.motion
        if motion is None:
            raise ValueError("the ensemble needs walls (/wall): this measurement has none")
        surface = motion.surface(float(self.measured.time[frame]))
        return replace(analysis, transform=None), regions_of(batch, control, surface, self.grid), earlier

    def _drawn(self, batch: ObservationBatch) -> Tensor:
        """(_DRAWS, m) draws from the ensemble's deviations as they are observed."""
        count = len(batch.members)
        draw = torch.randn((_DRAWS, count), generator=self.generator, dtype=torch.float64)
        return draw @ torch.nan_to_num(batch.members - batch.members.mean(0)).double() / (count - 1) ** 0.5

    def _increments(self, analysis: Analysis, found: Tensor, inside: Tensor, control: Tensor, mask: Tensor) -> Tensor:
        """(J, D, *shape) increments, each with one component alone, in the order of ``options.increments``."""
        increments = []
        for name in self.options.increments:
            if name == "ensemble":
                moved = self._on_grid(analysis.mean[None, : self.grid.dimension * len(inside)], inside)[0]
                whole = torch.where(mask, moved - control, 0.0)
            else:
                whole = found[0]
            increments.append(torch.diag_embed(whole.movedim(0, -1)).movedim((-2, -1), (0, 1)))
        return torch.cat(increments)

    def _match_spread(
        self, increments: Tensor, batch: ObservationBatch, used: Tensor, drawn: Tensor, found: Tensor
    ) -> None:
        """Compare what splines (1 + k, D, *shape) find in the innovations and in draws from the ensemble (k, m).

        Every observation in use counts alike: the spread stands for the error of the whole state, most of which lies
        where the observations are worst, in jets and shear.
        """
        if not len(found):
            return
        parts, first = self.grid.dimension, self.options.increments.index("spline") * self.grid.dimension
        predicted = batch.predicted(increments)
        followed = self.gain.weight @ predicted
        shown = float((predicted[first : first + parts].sum(0) * followed)[used].sum())
        own = float((batch.predicted(found[1:]) * drawn)[:, used].sum()) / len(drawn)
        self.spread_match.learn(shown, own)

    def _ensemble(
        self, state: Ensemble, analysis: Analysis, forecast: Tensor, change: Tensor, mask: Tensor, inside: Tensor
    ) -> tuple[Ensemble, Tensor]:
        """The control moved by ``change`` (D, *shape), around it the filter's anomalies with the spread left."""
        size = forecast.shape[1]
        control, analysed = state.control + change, analysis.ensemble[:, :size]
        anomalies = self._on_grid(analysed - analysis.mean[:size], inside)
        before, after = (float(part.double().var(0).sum()) for part in (forecast, analysed))
        left = self.spread_match.left(before, after, float(change[:, mask].double().square().sum()))
        parameters = self.augmentation.split(analysis.ensemble)[1] if state.parameters else {}
        sigma = left * self._on_grid(analysis.variance[:size].clamp_min(0).sqrt()[None], inside)[0]
        return Ensemble(control, control + left * anomalies, parameters), sigma

    def _record(
        self, analysis: Analysis, batch: ObservationBatch, forecast: Tensor, inside: Tensor, frame: int
    ) -> None:
        time, right = float(self.measured.time[frame]), None
        if self.truth is not None:
            number = frame_at(self.truth.time, time)
            if number is not None:
                right = torch.from_numpy(self.truth.velocity[number]).flatten(1)[:, inside].flatten()
        self.reason = analysis.reason
        self.record.add(
            time,
            analysis,
            batch.observations,
            regions=batch.regions,
            forecast=None if right is None else forecast,
            truth=right,
        )
        if not bool(torch.isin(analysis.reason, torch.tensor([Reason.USED, Reason.OUT_OF_REACH])).any()):
            self.analyses.happened(frame, coasted=True)

    def _on_grid(self, values: Tensor, inside: Tensor) -> Tensor:
        """(k, D, *shape) from (k, D * inside), 0 outside."""
        full = torch.zeros((len(values), self.grid.dimension, self.grid.size), dtype=torch.float32)
        full[:, :, inside] = values.reshape(len(values), self.grid.dimension, -1).to(torch.float32)
        return full.reshape(len(values), self.grid.dimension, *self.grid.shape)
