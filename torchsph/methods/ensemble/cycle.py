"""One cycle of the ensemble: forecast, look, analyse, learn; and everything that has to survive a restart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

import geometry
from geometry.grids.fields import fwhm_to_deviation
from torchsph.assimilation import (
    Analysis,
    Augmentation,
    ErrorScale,
    Filter,
    FilterRecord,
    LearnedGain,
    Reason,
    SpreadMatch,
    concatenate,
    replace_failed,
)

from ..frame_splines import FrameSmoother
from ..measurement.observation_operator import Seen, Source
from ..runtime.parallel import from_last, is_last, shared
from .divergence_cleaning import without_divergence
from .forecaster import Ensemble, Forecaster, Forecasts
from .innovation_spline import InnovationSpline, Look
from .lagged import Lagged, LaggedAnalyses
from .model_error import flow_perturbations
from .options import EnsembleOptions
from .regions import flow_regions

# draws from the ensemble whose splines tell how large its spread is: each costs a thirtieth of an analysis
_DRAWS = 3


class Cycle:
    """The ensemble on its way through the frames of the first source, whose grid and mask are the state's.

    Args:
        sources: measurements, the first one gives the state's grid, mask, walls and times of analysis.
        splines: of the first source. forecaster: runs the members. filter_: any filter of ``assimilation``.
        truth: for the record's scores alone; it never enters an analysis.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        splines: FrameSmoother,
        forecaster: Forecaster,
        filter_: Filter,
        options: EnsembleOptions,
        *,
        members: int,
        usual: float,
        truth: geometry.Recording | None = None,
        seed: int = 0,
    ) -> None:
        self.sources, self.splines, self.forecaster = list(sources), splines, forecaster
        self.filter, self.options, self.count, self.usual = filter_, options, members, usual
        self.measured, self.grid, self.truth = splines.recording, splines.recording.grid, truth
        self.nodes = self.grid.nodes()
        self.generator = torch.Generator().manual_seed(seed)
        self.augmentation = Augmentation(tuple(one.parameter for one in options.estimated))
        self.gain = LearnedGain(len(options.increments), self.grid.dimension, memory=options.memory)
        self.spread = SpreadMatch(averaged=options.memory)
        self.first_group = np.cumsum([0] + [source.groups for source in self.sources]).tolist()
        self.scale = ErrorScale(self.first_group[-1], memory=options.memory)
        self.record = FilterRecord(seed=seed)
        self.spline = InnovationSpline(splines, options.choose_every)
        self.lagged = None if options.lag is None else LaggedAnalyses(options.lag)
        self.offered: Tensor | None = None  # (J, D, *shape) increments of the last analysis
        self.fields: list[Tensor] = []
        self.sigmas: list[Tensor] = []
        self.missing: list[int] = []
        self.events: list[dict[str, Any]] = []
        self.shocks: list[float] = []
        self.ensemble: Ensemble | None = None

    @property
    def done(self) -> int:
        """Frames that have their analysis."""
        return len(self.fields)

    def mask(self, frame: int) -> Tensor:
        return torch.from_numpy(np.array(self.measured.mask[frame], bool))

    def begin(self) -> None:
        """The first frame: its spline and draws from the spline's posterior; walls alone where it measured nothing."""
        mask, generator = self.mask(0), self._forked()
        [(control, draws)] = shared([partial(self._first, generator)])
        parameters = {one.parameter.name: one.draw(self.count, self.generator) for one in self.options.estimated}
        self.ensemble = Ensemble(control, control + draws, parameters).centred()
        self._keep(control, torch.where(mask, self.ensemble.members.std(0), 0.0), 0)

    def _first(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """The first control (D, *shape), and deviations of the members (N, D, *shape)."""
        if self.splines.measures(0):
            fitted = self.splines.fit(0, uncertainty=True)
            control = torch.from_numpy(self.splines.on_grid(fitted, 0))
            return control, self.splines.draws(fitted, 0, self.count, generator).to(control.dtype)
        control = torch.zeros((self.grid.dimension, *self.grid.shape))
        return control, self._perturbations(0, self.usual, generator)

    def step(self, frame: int) -> None:
        """From the analysis of the frame before to that of ``frame``."""
        before, now = (float(t) for t in self.measured.time[frame - 1 : frame + 1])
        early, late = self.mask(frame - 1), self.mask(frame)
        seen = [
            (source, source.see(number), float(source.recording.time[number]))
            for source in self.sources
            for number in source.frames_within(before, now)
        ]
        times = sorted({time for _, _, time in seen if time < now - 1e-6}) + [now]
        masks = [early | late] * (len(times) - 1) + [late]
        generator = self._forked()
        noise = self._perturbations(frame, 1.0, generator) if is_last() and self.options.model_error > 0 else None
        forecasts = self.forecaster.advance(self.ensemble, before, early, times, masks)
        self.shocks.append(forecasts.shock)
        states = self._prepared(forecasts, from_last(noise), frame)
        look = self._look([(source, what, _nearest(times, time)) for source, what, time in seen], states, masks)
        missing = int((late & ~forecasts.covered).sum())
        if look is None:
            self.offered = None
            self._coast(states[-1], late, missing, now)
        else:
            self._analyse(states, masks, look, frame, missing)

    # --- forecast -------------------------------------------------------------------------------------

    def _perturbations(self, frame: int, amplitude: float, generator: torch.Generator | None = None) -> Tensor:
        length = self.options.length
        if length is None:
            length = max(fwhm_to_deviation(self.sources[0].kernel), float(np.mean(self.grid.spacing)))
        return flow_perturbations(
            self.count,
            np.array(self.measured.mask[frame], bool),
            self.grid.spacing,
            amplitude,
            length,
            generator or self.generator,
        ).to(torch.float32)

    def _prepared(self, forecasts: Forecasts, noise: Tensor | None, frame: int) -> list[Ensemble]:
        """Forecasts with failed members replaced, model error added, and the spread that the innovations ask for.

        ``noise`` (N, D, *shape): the model error's perturbations, of RMS 1.
        """
        states, time = forecasts.states, float(self.measured.time[frame])
        if forecasts.control_failed:
            self.events.append({"time": time, "failed": "control", "donor": "mean of the members"})
        if bool(forecasts.failed.any()):
            states = self._replaced(states, forecasts.failed, frame)
        mask = self.mask(frame)
        rms = max(float(states[-1].control[:, mask].square().mean().sqrt()), self.usual)
        error = 0.0 if noise is None else self.options.model_error * rms * noise
        prepared = []
        for state in states:
            anomalies = state.members - state.members.mean(0) + error
            prepared.append(replace(state, members=state.control + self.spread.factor * anomalies))
        return prepared

    def _replaced(self, states: list[Ensemble], failed: Tensor, frame: int) -> list[Ensemble]:
        time = float(self.measured.time[frame])
        members = torch.stack([state.members for state in states], 1)
        if int((~failed).sum()) < 2:  # too few to draw from: a new ensemble around the control
            fresh = self._perturbations(frame, self.usual)
            members = torch.stack([state.control + fresh for state in states], 1)
            if self.lagged is not None:
                self.lagged.clear()
            self.events.append({"time": time, "failed": torch.nonzero(failed).flatten().tolist(), "donor": "control"})
        else:
            repaired = replace_failed(members.flatten(1), failed, self.generator)
            members = repaired.ensemble.reshape(members.shape)
            self.events += [{"time": time, "failed": e.member, "donor": e.donor} for e in repaired.events]
            for event in repaired.events if self.lagged is not None else ():
                self.lagged.replaced(event.member, event.donor)
        return [replace(state, members=members[:, k]) for k, state in enumerate(states)]

    # --- observations ---------------------------------------------------------------------------------

    def _look(self, parts: list[tuple[Source, Seen, int]], states: list[Ensemble], masks: list[Tensor]) -> Look | None:
        parts = [part for part in parts if len(part[1].position)]
        if not parts:
            return None
        group = torch.cat(
            [
                torch.arange(seen.parts).repeat_interleave(len(seen.position))
                + self.first_group[self.sources.index(source)]
                for source, seen, _ in parts
            ]
        )
        observations = self.scale.apply(concatenate([seen.observations for _, seen, _ in parts]), group)
        members = torch.cat([source.predict(states[k].members, masks[k], seen) for source, seen, k in parts], 1)
        return Look(parts, observations, group, members)

    def _regions(self, parts: list[tuple[Source, Seen, int]], control: Tensor, frame: int) -> dict[str, Tensor]:
        surface = self.splines.motion.surface(float(self.measured.time[frame]))
        speed = control.norm(dim=0)[None]
        found = [
            {
                name: mask.repeat(seen.parts)
                for name, mask in flow_regions(
                    surface, seen.position, self.grid.sample(speed, seen.position)[0], float(min(self.grid.spacing))
                ).items()
            }
            for _, seen, _ in parts
        ]
        return {name: torch.cat([one[name] for one in found]) for name in found[0]}

    # --- analysis -------------------------------------------------------------------------------------

    def _analyse(self, states: list[Ensemble], masks: list[Tensor], look: Look, frame: int, missing: int) -> None:
        mask, state = masks[-1], states[-1]
        inside = torch.nonzero(mask.flatten()).squeeze(1)
        forecast = state.members.flatten(2)[:, :, inside].flatten(1)
        size, positions = forecast.shape[1], self.nodes[inside]
        joint = forecast
        if state.parameters:
            joint = self.augmentation.join(forecast, state.parameters)
            positions = self.augmentation.positions(positions, size)
        screened = self.filter.screen(joint, look.members, look.observations)
        weight = torch.where(screened.used, 1.0 / screened.variance, 0.0)
        if self.offered is not None:
            self.gain.learn(self._seen(self.offered, masks, look), screened.innovation, weight)
        drawn = self._drawn(look)
        tasks = [
            partial(self._splines, torch.cat([screened.innovation[None], drawn]), weight, look, frame),
            partial(self._filtered, joint, look, positions, state.control, frame, inside, self._forked()),
        ]
        (found, choice), (analysis, regions, earlier) = shared(tasks)
        if self.lagged is not None:
            self._take_earlier(earlier)
        self.spline.restore(choice)
        look = replace(look, regions=regions)
        self._record(analysis, look, forecast, inside, frame)
        self.offered = self._increments(analysis, found, inside, state.control, frame)
        change = torch.einsum("j,jd...->d...", self.gain.weight.to(torch.float32), self.offered)
        self._match_spread(masks, look, weight > 0, drawn, found)
        self.scale.learn(analysis, look.observations, look.group)
        control = state.control + change
        anomalies, parameters = self._on_grid(analysis.ensemble[:, :size] - analysis.mean[:size], inside), {}
        before, after = (float(part.double().var(0).sum()) for part in (forecast, analysis.ensemble[:, :size]))
        left = self.spread.left(before, after, float(change[:, mask].double().square().sum()))
        anomalies = left * anomalies
        if state.parameters:
            _, parameters = self.augmentation.split(analysis.ensemble)
        self.ensemble = Ensemble(control, control + anomalies, parameters)
        sigma = left * self._on_grid(analysis.variance[:size].clamp_min(0).sqrt()[None], inside)[0]
        self._keep(torch.where(mask, control, 0.0), sigma, missing)

    def _splines(self, values: Tensor, weight: Tensor, look: Look, frame: int) -> tuple[Tensor, dict[str, Any] | None]:
        """The splines (k, D, *shape) of numbers (k, m), k = 0 where none are used, and what is remembered of them."""
        if "spline" not in self.options.increments:
            return torch.zeros((0, self.grid.dimension, *self.grid.shape)), None
        return self.spline.of(values, weight, look, frame), self.spline.state()

    def _filtered(
        self,
        joint: Tensor,
        look: Look,
        positions: Tensor,
        control: Tensor,
        frame: int,
        inside: Tensor,
        generator: torch.Generator,
    ) -> tuple[Analysis, dict[str, Tensor], list[Lagged]]:
        """The filter's analysis, without its map of the members, which is large and has served; regions; the past."""
        analysis = self.filter.analyse(
            joint, look.members, look.observations, state_positions=positions, generator=generator
        )
        numbers = self.grid.dimension * len(inside)
        earlier = [] if self.lagged is None else self.lagged.improved(analysis, inside, numbers)
        return replace(analysis, transform=None), self._regions(look.parts, control, frame), earlier

    def _forked(self) -> torch.Generator:
        """A generator of its own for what one process alone may do."""
        return torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=self.generator)))

    def _drawn(self, look: Look) -> Tensor:
        """(_DRAWS, m) draws from the ensemble's deviations as they are observed."""
        draw = torch.randn((_DRAWS, self.count), generator=self.generator, dtype=torch.float64)
        return draw @ torch.nan_to_num(look.members - look.members.mean(0)).double() / (self.count - 1) ** 0.5

    def _seen(self, fields: Tensor, masks: list[Tensor], look: Look) -> Tensor:
        """(J, m) fields (J, D, *shape) where they are observed; 0 where nothing of them is."""
        return torch.nan_to_num(
            torch.cat([source.predict(fields, masks[k], seen) for source, seen, k in look.parts], 1)
        )

    def _increments(self, analysis: Analysis, found: Tensor, inside: Tensor, control: Tensor, frame: int) -> Tensor:
        """(J, D, *shape) increments, each with one component alone, in the order of ``options.increments``."""
        parts = self.grid.dimension
        offered = []
        for name in self.options.increments:
            if name == "ensemble":
                size = parts * len(inside)
                moved = self._on_grid(analysis.mean[None, :size], inside)[0]
                whole = torch.where(self.mask(frame), moved - control, 0.0)
            else:
                whole = found[0]
            offered.append(torch.diag_embed(whole.movedim(0, -1)).movedim((-2, -1), (0, 1)))
        return torch.cat(offered)

    def _match_spread(self, masks: list[Tensor], look: Look, used: Tensor, drawn: Tensor, found: Tensor) -> None:
        """Compare what splines (1 + k, D, *shape) find in the innovations and in draws from the ensemble (k, m).

        Every observation in use counts alike: the spread stands for the error of the whole state, most of which lies
        where the observations are worst, in jets and shear.
        """
        if not len(found):
            return
        parts, first = self.grid.dimension, self.options.increments.index("spline") * self.grid.dimension
        seen = self._seen(self.offered, masks, look)
        followed = self.gain.weight @ seen
        shown = float((seen[first : first + parts].sum(0) * followed)[used].sum())
        own = float((self._seen(found[1:], masks, look) * drawn)[:, used].sum()) / len(drawn)
        self.spread.learn(shown, own)

    def _coast(self, state: Ensemble, mask: Tensor, missing: int, time: float) -> None:
        """Nothing was measured: the forecast is the analysis."""
        self.ensemble = state
        self.events.append({"time": time, "coasted": True})
        self._keep(torch.where(mask, state.control, 0.0), torch.where(mask, state.members.std(0), 0.0), missing)

    # --- accounts -------------------------------------------------------------------------------------

    def _record(self, analysis: Analysis, look: Look, forecast: Tensor, inside: Tensor, frame: int) -> None:
        time, right = float(self.measured.time[frame]), None
        if self.truth is not None:
            gaps = np.abs(self.truth.time - time)
            if gaps.min() < 1e-6:
                right = torch.from_numpy(self.truth.velocity[int(gaps.argmin())]).flatten(1)[:, inside].flatten()
        self.record.add(
            time,
            analysis,
            look.observations,
            regions=look.regions,
            forecast=None if right is None else forecast,
            truth=right,
        )
        if not bool(torch.isin(analysis.reason, torch.tensor([Reason.USED, Reason.OUT_OF_REACH])).any()):
            self.events.append({"time": time, "coasted": True})

    def _on_grid(self, values: Tensor, inside: Tensor) -> Tensor:
        """(k, D, *shape) from (k, D * inside), 0 outside."""
        full = torch.zeros((len(values), self.grid.dimension, self.grid.size), dtype=torch.float32)
        full[:, :, inside] = values.reshape(len(values), self.grid.dimension, -1).to(torch.float32)
        return full.reshape(len(values), self.grid.dimension, *self.grid.shape)

    def _keep(self, control: Tensor, sigma: Tensor, missing: int) -> None:
        if self.lagged is not None:
            self.lagged.add(self.done, control, self.ensemble.members - self.ensemble.control, sigma)
        self.fields.append(self._clean(control, self.done))
        self.sigmas.append(sigma.to(torch.float32))
        self.missing.append(missing)

    def _take_earlier(self, earlier: list[Lagged]) -> None:
        self.lagged.take(earlier)
        for one in earlier:
            mask = self.mask(one.frame)
            self.fields[one.frame] = self._clean(torch.where(mask, one.control, 0.0), one.frame)
            self.sigmas[one.frame] = one.sigma

    def _clean(self, control: Tensor, frame: int) -> Tensor:
        mask = np.array(self.measured.mask[frame], bool)
        found = without_divergence(control.numpy(), mask, self.grid.spacing)
        if not found.converged:
            self.events.append({"time": float(self.measured.time[frame]), "divergence_left": found.left})
        return torch.from_numpy(found.velocity).to(torch.float32)

    def state(self) -> dict[str, Any]:
        """Everything that the next step depends on, as tensors and plain values."""
        return {
            "ensemble": {
                "control": self.ensemble.control,
                "members": self.ensemble.members,
                "parameters": dict(self.ensemble.parameters),
            },
            "generator": self.generator.get_state(),
            "gain": self.gain.state(),
            "spread": self.spread.state(),
            "scale": self.scale.state(),
            "record": self.record.state(),
            "spline": self.spline.state(),
            "offered": self.offered,
            "fields": list(self.fields),
            "sigmas": list(self.sigmas),
            "missing": list(self.missing),
            "events": list(self.events),
            "shocks": list(self.shocks),
            "lagged": [] if self.lagged is None else self.lagged.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self.ensemble = Ensemble(**state["ensemble"])
        self.generator.set_state(state["generator"])
        for name in ("gain", "spread", "scale", "record", "spline"):
            getattr(self, name).restore(state[name])
        self.offered = state["offered"]
        self.fields, self.sigmas = list(state["fields"]), list(state["sigmas"])
        self.missing, self.events, self.shocks = (list(state[name]) for name in ("missing", "events", "shocks"))
        if self.lagged is not None:
            self.lagged.restore(state["lagged"])


def _nearest(times: list[float], time: float) -> int:
    return int(np.abs(np.array(times) - time).argmin())
