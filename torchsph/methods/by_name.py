"""The pipeline that the command line calls: methods by name, with sensible sizes, each timed."""

from __future__ import annotations

import time as clock
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import geometry
import regularize
from geometry.arguments import between, checked
from torchsph.simulator.scene import Scene
from torchsph.simulator.schemes.presets import preset as scheme_preset
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.state.checks import MOST_MEMBERS, SPACING

from .ensemble.assimilate import EnsembleRun, assimilate, default_filter, further
from .ensemble.identity import ensemble_key
from .ensemble.options import EnsembleOptions
from .forecast_skill import ForecastSkill, skill
from .free_run import run_freely
from .measurement.prepared import PreparedMeasurement
from .members.amplitude import Amplitude
from .members.draws import spline_frames
from .members.frames import FrameObserver
from .members.kept import MemberFile
from .members.quantities import MemberCurves, MemberQuantities, quantified, with_pressure
from .memory import MemoryPrediction, free_memory, predicted
from .nudging import filter_sph
from .runtime.checkpoint import Saved
from .runtime.parallel import from_last, is_last, is_lead
from .runtime.watching import Watcher

METHODS = ("free", "spline", "sph", "ensemble")
# Written to analysis.h5 and run when no method is named: the one that wins on a CFD phantom in every case tried. RMS
# error of the ensemble over that of the splines: .80 and .75 over the beat at two noise levels; over 200 ms of ejection
# and filling .84, .75, .68 and .67 at 25, 50, 100 and 200 Hz, .69 and .66 at half and double noise, .69 with a weight
# that says nothing, .71 with one Doppler component (filter_*.json in examples/benchmarks/results).
DEFAULT_METHOD = "ensemble"
DEFAULT_MEMBERS = 16
# particle spacing in grid spacings of the single runs and of the ensemble's members; its control run takes half of it
ANALYSIS_SPACING = 2.0
CONTROL_SHARE = 0.5
# of a recording's frames, what forecasts from them hold at once beside those that are saved
FORECAST_COPIES = 2

# Between frames that correct it, coarser particles resolve less in time as well: in a human ventricle with 3 and 6 mm,
# steps of up to 0.7 spacings per m/s leave the ensemble's error as it is (.410, .409 with 0.7 ms) at 0.64 times the
# cost. At 1 mm they are the preset's own.
LONG_STEPS: dict[str, Any] = {"max_step": None, "longest_step": 0.7}


@dataclass(frozen=True)
class MethodResult:
    """What one method made of a measurement, and where they were asked for the quantities of all its members."""

    recording: geometry.Recording
    seconds: float
    info: dict[str, Any] = field(default_factory=dict)
    quantities: MemberCurves | None = None


@checked(spacing=SPACING)
def make_model(
    recording: geometry.Recording,
    *,
    preset: str = "default",
    spacing: float | None = None,
    device: str = "cpu",
    estimates: geometry.Estimates | None = None,
) -> Simulator:
    """A simulator of the recording's walls and valves.

    Args:
        recording: whose walls, valves and fluid they are.
        preset: name of the scheme.
        spacing: of the particles, m; None: the grid's.
        device: where particles live.
        estimates: what ``geometry.estimated`` found of the recording, where that is known already.
    """
    scene = Scene.from_recording(recording, spacing, estimates=estimates)
    scheme = scheme_preset(preset, **LONG_STEPS) if preset == "default" else scheme_preset(preset)
    return Simulator(scene, scheme, device=device)


def make_smoother(preset: str) -> regularize.Smoother:
    """The splines that go with a simulator's preset: the thesis's with the thesis's, else the default ones."""
    return regularize.Smoother.preset("thesis" if preset == "thesis" else "default")


@checked(spacing=SPACING, members=between(1, MOST_MEMBERS))
def run_methods(
    measured: geometry.Recording,
    methods: Sequence[str],
    *,
    preset: str = "default",
    spacing: float | None = None,
    members: int | None = None,
    also: Sequence[geometry.Recording] = (),
    truth: geometry.Recording | None = None,
    lag: int | None = None,
    minimum_members: int | None = None,
    checkpoints: str | Path | None = None,
    resume: bool | Saved = False,
    watcher: Watcher | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: bool = False,
    quantities: Collection[str] = (),
    keep_members: Path | None = None,
) -> dict[str, MethodResult]:
    """Run methods by name on one measurement, in the order of ``METHODS``.

    "free", the run without data, comes along with every method that simulates. ``spacing`` (m) of the particles
    defaults to ``ANALYSIS_SPACING`` grid spacings, half of it in the ensemble's control run; ``members`` to
    ``DEFAULT_MEMBERS``. ``also``, ``truth``, ``lag``, ``minimum_members``, ``checkpoints``, ``resume`` and ``watcher``
    are the ensemble's (``assimilate``, ``EnsembleOptions``); the other methods know one measurement. The seconds of a
    method include the spline that it starts from only where "spline" itself was not asked for. ``quantities`` names the
    methods whose members are read out ("ensemble", and "spline" by as many draws as members); ``keep_members`` is the
    file to which the ensemble's are written.

    Under torchrun all processes share the splines and the ensemble; the first one runs "sph" meanwhile and the last
    one "free". What the first one returns is complete.

    Raises:
        ValueError: an unknown method, "sph" on a measurement of components alone, or a checkpoint of another run.
        NotEnoughMemory: more would be needed than is free.
    """
    _check(methods, measured)
    if not methods:
        return {}
    smoother, timer = make_smoother(preset), _Timer()
    prepared = PreparedMeasurement(measured, smoother, progress=progress)
    models = _Models(prepared, preset, spacing, device)
    count = DEFAULT_MEMBERS if members is None else members
    predicted_memory(prepared, methods, preset, models.spacing, count, also).refuse_beyond(free_memory())
    ensemble = None
    if "ensemble" in methods:
        ensemble = _EnsembleCall(
            prepared,
            models,
            also,
            members=count,
            options=EnsembleOptions(lag=lag, minimum_members=minimum_members),
            truth=truth,
            checkpoints=None if checkpoints is None else Path(checkpoints),
            resume=_read_once(resume, checkpoints),
            seed=seed,
            quantities="ensemble" in quantities,
            keep_members=keep_members,
        )
        ensemble.refuse_foreign_checkpoint()
    smoothed = prepared.smoothed  # by all processes together
    mended = {"estimates": found} if (found := prepared.splines.estimates.summary()) else {}
    results: dict[str, MethodResult] = {}
    if "spline" in methods:
        drawn = _drawn(prepared, count, seed) if "spline" in quantities and is_lead() else None
        results["spline"] = timer.result(with_pressure(smoothed, drawn), {"smoother": repr(smoother)} | mended, drawn)
    if is_last() and set(methods) != {"spline"}:
        free = run_freely(measured, models.coarse, smoothed.velocity[0], seed=seed, progress=progress)
        results["free"] = timer.result(free)
    if is_lead() and "sph" in methods:
        run = filter_sph(prepared, models.coarse, seed=seed, progress=progress)
        results["sph"] = timer.result(run.recording, run.info)
    if ensemble is not None:
        done, curves = ensemble.run(watcher, progress)
        results["ensemble"] = timer.result(with_pressure(done.recording, curves), done.info | mended, curves)
    return _collected(results)


def predicted_memory(
    prepared: PreparedMeasurement,
    methods: Sequence[str],
    preset: str = "default",
    spacing: float | None = None,
    members: int = DEFAULT_MEMBERS,
    also: Sequence[geometry.Recording] = (),
) -> MemoryPrediction:
    """What ``run_methods`` with the same options will take."""
    spacing = _spacing(prepared, spacing)
    simulated = set(methods) - {"spline"}
    runs = [(spacing, 1)] if simulated else []
    if "ensemble" in methods:
        runs = [(spacing, min(members, EnsembleOptions().batch)), (CONTROL_SHARE * spacing, 1)]
    return predicted(
        prepared.recording,
        scheme_preset(preset),
        splines=prepared.splines,
        spacings=runs,
        members=members if "ensemble" in methods else 0,
        further=also,
    )


def predicted_forecast_memory(
    recording: geometry.Recording, saved: Sequence[float] = (), preset: str = "default", spacing: float | None = None
) -> MemoryPrediction:
    """What ``forecast_skill`` with the same options will take, where the forecasts at the leads ``saved`` are kept."""
    spacing = min(recording.grid.spacing) if spacing is None else spacing
    copies = FORECAST_COPIES + 2 * len(saved)
    return predicted(recording, scheme_preset(preset), spacings=[(spacing, 1)], copies=copies)


def _spacing(prepared: PreparedMeasurement, asked: float | None) -> float:
    """Of the particles of single runs and of the ensemble's members, m."""
    return ANALYSIS_SPACING * min(prepared.recording.grid.spacing) if asked is None else asked


class _Models:
    """The simulators of a measurement, each made when it is first asked for."""

    def __init__(self, prepared: PreparedMeasurement, preset: str, spacing: float | None, device: str) -> None:
        self.prepared, self.preset, self.device = prepared, preset, device
        self.spacing = _spacing(prepared, spacing)

    @cached_property
    def coarse(self) -> Simulator:
        """Of single runs and of the ensemble's members."""
        return self._at(self.spacing)

    @cached_property
    def fine(self) -> Simulator:
        """Of the ensemble's control."""
        return self._at(CONTROL_SHARE * self.spacing)

    def _at(self, spacing: float) -> Simulator:
        found = self.prepared.splines.estimates
        return make_model(
            self.prepared.recording, preset=self.preset, spacing=spacing, device=self.device, estimates=found
        )


@dataclass(frozen=True)
class _EnsembleCall:
    """An ensemble's run with all that it is to be told, before anything is computed."""

    prepared: PreparedMeasurement
    models: _Models
    also: Sequence[geometry.Recording]
    members: int
    options: EnsembleOptions
    truth: geometry.Recording | None
    checkpoints: Path | None
    resume: bool | Saved
    seed: int
    quantities: bool = False
    keep_members: Path | None = None

    def refuse_foreign_checkpoint(self) -> None:
        """Tell another run's checkpoint before splines and free runs have taken their minutes."""
        if not isinstance(self.resume, Saved):
            return
        key = ensemble_key(
            [self.prepared, *(further(one, self.prepared) for one in self.also)],
            self.models.fine,
            self.models.coarse,
            default_filter(self.prepared.recording, self.options),
            self.options,
            members=self.members,
            seed=self.seed,
            truth=self.truth,
        )
        self.resume.refuse_foreign(key)

    def run(self, watcher: Watcher | None, progress: bool) -> tuple[EnsembleRun, MemberCurves | None]:
        """The ensemble's analyses, and what its members give where it is asked for."""
        quantities = MemberQuantities(self.prepared.recording, strict=False) if self.quantities else None
        read: list[FrameObserver] = [] if quantities is None else [quantities]
        if self.keep_members is not None:
            read.append(MemberFile(self.keep_members, self.prepared.recording, self.members))
        run = assimilate(
            self.prepared,
            self.models.fine,
            coarse=self.models.coarse,
            members=self.members,
            options=self.options,
            also=self.also,
            truth=self.truth,
            checkpoints=self.checkpoints,
            resume=self.resume,
            watcher=watcher,
            seed=self.seed,
            progress=progress,
            observers=read,
        )
        if quantities is None or quantities.fault is not None or not is_lead():
            return run, None
        return run, quantities.found()


def _check(methods: Sequence[str], measured: geometry.Recording) -> None:
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ValueError(f"unknown method {', '.join(unknown)}; known: {', '.join(METHODS)}")
    if "sph" in methods:
        geometry.measurement_type(measured).require_full("method sph imposes")


def _read_once(resume: bool | Saved, checkpoints: str | Path | None) -> bool | Saved:
    """What to go on from, its file read by the first process before any work."""
    if resume is True and checkpoints is not None and is_lead():
        return Saved.read(Path(checkpoints)) or True
    return resume


def _drawn(prepared: PreparedMeasurement, count: int, seed: int) -> MemberCurves:
    """What draws from the splines' posterior give."""
    amplitude = Amplitude(prepared.balance, prepared.amplitude_error, count, seed)
    frames = spline_frames(prepared.splines, prepared.smoothed, count, seed=seed, amplitude=amplitude)
    return quantified(prepared.smoothed, frames)


def _collected(results: dict[str, MethodResult]) -> dict[str, MethodResult]:
    """In the order of ``METHODS``, "free" from the process that ran it."""
    free = from_last(results.get("free"))
    known = results if free is None else results | {"free": free}
    return {name: known[name] for name in METHODS if name in known}


class _Timer:
    """Seconds between the results of one run after another."""

    def __init__(self) -> None:
        self.began = clock.perf_counter()

    def result(
        self,
        recording: geometry.Recording,
        info: dict[str, Any] | None = None,
        quantities: MemberCurves | None = None,
    ) -> MethodResult:
        ended = clock.perf_counter()
        seconds, self.began = ended - self.began, ended
        return MethodResult(recording, seconds, {} if info is None else info, quantities)


@checked(every=between(1, 2**31), spacing=SPACING)
def forecast_skill(
    recording: geometry.Recording,
    leads: Sequence[float],
    *,
    every: int = 1,
    preset: str = "default",
    spacing: float | None = None,
    device: str = "cpu",
    save: bool = False,
    progress: bool = False,
    seed: int = 0,
) -> ForecastSkill:
    """Skill of the simulator on a recording; see ``skill``. ``spacing`` (m) defaults to the grid's.

    Raises:
        NotEnoughMemory: more would be needed than is free.
    """
    began = clock.perf_counter()
    predicted_forecast_memory(recording, leads if save else (), preset, spacing).refuse_beyond(free_memory())
    model = make_model(recording, preset=preset, spacing=spacing, device=device)
    made = clock.perf_counter() - began
    result = skill(recording, model, leads, every=every, save=save, progress=progress, seed=seed)
    result.seconds["setup"] += made
    return result
