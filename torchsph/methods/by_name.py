"""The pipeline that the command line calls: methods by name, with sensible sizes, each timed."""

from __future__ import annotations

import time as clock
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import geometry
import regularize
from geometry.arguments import between, checked
from torchsph.simulator.schemes.presets import preset as scheme_preset
from torchsph.simulator.state.checks import MOST_MEMBERS, SPACING

from .ensemble.options import EnsembleOptions
from .forecast_skill import ForecastSkill, skill, starts
from .measurement.frame_splines import CHOICE_EVERY
from .measurement.prepared import PreparedMeasurement
from .memory import MemoryPrediction, free_memory, predicted
from .methods_run import METHODS, MethodResult, MethodsRun
from .models import Models, make_model
from .runtime.checkpoint import Saved
from .runtime.parallel import is_lead
from .runtime.watching import Watcher
from .runtime.workers import MOST_WORKERS, chosen_workers, spread

__all__ = [
    "DEFAULT_MEMBERS",
    "DEFAULT_METHOD",
    "METHODS",
    "MethodResult",
    "forecast_skill",
    "make_model",
    "make_smoother",
    "parallel_tasks",
    "predicted_forecast_memory",
    "predicted_memory",
    "run_methods",
]

# Written to analysis.h5 and run when no method is named: the one that wins on a CFD phantom in every case tried. RMS
# error of the ensemble over that of the splines: .80 and .75 over the beat at two noise levels; over 200 ms of ejection
# and filling .84, .75, .68 and .67 at 25, 50, 100 and 200 Hz, .69 and .66 at half and double noise, .69 with a weight
# that says nothing, .71 with one Doppler component (filter_*.json in examples/benchmarks/results).
DEFAULT_METHOD = "ensemble"
DEFAULT_MEMBERS = 16
# of a recording's frames, what forecasts from them hold at once beside those that are saved
FORECAST_COPIES = 2


def make_smoother(preset: str) -> regularize.Smoother:
    """The splines that go with a simulator's preset: the thesis's with the thesis's, else the default ones."""
    return regularize.Smoother.preset("thesis" if preset == "thesis" else "default")


@checked(spacing=SPACING, control_spacing=SPACING, members=between(1, MOST_MEMBERS), workers=between(1, MOST_WORKERS))
def run_methods(
    measured: geometry.Recording,
    methods: Sequence[str],
    *,
    preset: str = "default",
    spacing: float | None = None,
    control_spacing: float | None = None,
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
    workers: int | None = 1,
) -> dict[str, MethodResult]:
    """Run methods by name on one measurement, in the order of ``METHODS``.

    "free", the run without data, comes along with every method that simulates. ``spacing`` (m) of the particles
    defaults to ``ANALYSIS_SPACING`` grid spacings, ``control_spacing``, of the ensemble's control run, to half of it;
    ``members`` to ``DEFAULT_MEMBERS``. ``also``, ``truth``, ``lag``, ``minimum_members``, ``checkpoints``, ``resume``
    and ``watcher`` are the ensemble's (``assimilate``, ``EnsembleOptions``); the other methods know one measurement.
    The seconds of a method include the spline that it starts from only where "spline" itself was not asked for.
    ``quantities`` names the methods whose members are read out ("ensemble", and "spline" by as many draws as members);
    ``keep_members`` is the file to which the ensemble's are written.

    ``workers`` processes of one thread each, this one among them, share the splines and the ensemble, with the same
    result to the last bit for any number; "free" and "sph" have one each. None: as many as this process may use cores,
    as the ensemble can give work to and as fit into the memory. Under torchrun its processes share the run in the same
    way, and what the first one returns is complete.

    Raises:
        ValueError: an unknown method, "sph" on a measurement of components alone, or a checkpoint of another run.
        NotEnoughMemory: more would be needed than is free.
        LostWorker: a worker was killed or has crashed.
    """
    _check(methods, measured)
    if not methods:
        return {}
    prepared = PreparedMeasurement(measured, make_smoother(preset), progress=progress)
    models = Models(prepared, preset, spacing, device, control_spacing)
    count = DEFAULT_MEMBERS if members is None else members
    foretold = predicted_memory(prepared, methods, preset, models.spacing, count, also, models.control_spacing)
    free = free_memory()
    options = EnsembleOptions(lag=lag, minimum_members=minimum_members)
    tasks = parallel_tasks(measured.frames, methods, count, options.batch) if device == "cpu" else 1
    processes = chosen_workers(workers, tasks, lambda number: foretold.in_processes(number).fits(free))
    foretold.in_processes(processes).refuse_beyond(free)
    run = MethodsRun(
        measured,
        prepared,
        models,
        methods,
        also,
        members=count,
        options=options,
        truth=truth,
        checkpoints=None if checkpoints is None else Path(checkpoints),
        resume=_read_once(resume, checkpoints),
        seed=seed,
        quantities=quantities,
        keep_members=keep_members,
        processes=processes,
    )
    run.refuse_foreign_checkpoint()
    return spread(partial(run.results, watcher, progress), run.for_worker().results, processes)


def parallel_tasks(
    frames: int, methods: Sequence[str], members: int = DEFAULT_MEMBERS, batch: int = EnsembleOptions.batch
) -> int:
    """How many processes find work: on the members and the control, or on the splines where there are no members."""
    if "ensemble" in methods:
        return 1 + -(-members // batch)
    return 2 if "sph" in methods else -(-frames // CHOICE_EVERY)


def predicted_memory(
    prepared: PreparedMeasurement,
    methods: Sequence[str],
    preset: str = "default",
    spacing: float | None = None,
    members: int = DEFAULT_MEMBERS,
    also: Sequence[geometry.Recording] = (),
    control_spacing: float | None = None,
) -> MemoryPrediction:
    """What ``run_methods`` with the same options will take."""
    models = Models(prepared, preset, spacing, "cpu", control_spacing)  # makes none of them
    spacing = models.spacing
    simulated = set(methods) - {"spline"}
    runs = [(spacing, 1)] if simulated else []
    if "ensemble" in methods:
        runs = [(spacing, min(members, EnsembleOptions().batch)), (models.control_spacing, 1)]
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


@checked(every=between(1, 2**31), spacing=SPACING, workers=between(1, MOST_WORKERS))
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
    workers: int | None = 1,
) -> ForecastSkill:
    """Skill of the simulator on a recording; see ``skill``. ``spacing`` (m) defaults to the grid's.

    ``workers`` processes of one thread each share the starts; see ``run_methods``.

    Raises:
        NotEnoughMemory: more would be needed than is free.
        LostWorker: a worker was killed or has crashed.
    """
    foretold = predicted_forecast_memory(recording, leads if save else (), preset, spacing)
    free = free_memory()
    tasks = len(starts(recording, leads, every)) if device == "cpu" else 1
    processes = chosen_workers(workers, tasks, lambda number: foretold.in_processes(number).fits(free))
    foretold.in_processes(processes).refuse_beyond(free)
    work = partial(
        _skill, recording, leads, every=every, preset=preset, spacing=spacing, device=device, save=save, seed=seed
    )
    result = spread(partial(work, progress=progress), work, processes)
    return result if processes == 1 else replace(result, config=result.config | {"processes": processes})


def _skill(
    recording: geometry.Recording,
    leads: Sequence[float],
    *,
    every: int,
    preset: str,
    spacing: float | None,
    device: str,
    save: bool,
    seed: int,
    progress: bool = False,
) -> ForecastSkill:
    """``forecast_skill`` as each of several processes calls it."""
    began = clock.perf_counter()
    model = make_model(recording, preset=preset, spacing=spacing, device=device)
    made = clock.perf_counter() - began
    result = skill(recording, model, leads, every=every, save=save, progress=progress, seed=seed)
    result.seconds["setup"] += made
    return result
