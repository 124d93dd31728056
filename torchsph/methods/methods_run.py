"""Several methods on one measurement, one after another: what every process of a run does, each its part."""

from __future__ import annotations

import time as clock
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import geometry

from .ensemble.assimilate import EnsembleRun, assimilate, default_filter, further
from .ensemble.identity import ensemble_key
from .ensemble.options import EnsembleOptions
from .free_run import run_freely
from .measurement.prepared import PreparedMeasurement
from .members.amplitude import Amplitude
from .members.draws import spline_frames
from .members.frames import FrameObserver
from .members.kept import MemberFile
from .members.quantities import MemberCurves, MemberQuantities, quantified, with_pressure
from .models import Models
from .nudging import filter_sph
from .runtime.checkpoint import Saved
from .runtime.parallel import from_last, is_last, is_lead
from .runtime.watching import Watcher

METHODS = ("free", "spline", "sph", "ensemble")


@dataclass(frozen=True)
class MethodResult:
    """What one method made of a measurement, and where they were asked for the quantities of all its members."""

    recording: geometry.Recording
    seconds: float
    info: dict[str, Any] = field(default_factory=dict)
    quantities: MemberCurves | None = None


@dataclass(frozen=True)
class MethodsRun:
    """All that a run of methods is to be told, before anything is computed; see ``by_name.run_methods``.

    Attributes:
        measured: as it was given; ``prepared``, with what is derived from it. models: its simulators.
        methods: names of them.
        also: further measurements.
        members: of the ensemble, and draws from the splines.
        options: of the ensemble.
        truth: for the ensemble's own scores.
        checkpoints: the ensemble's file; ``resume``: whether to go on from it, or what it held.
        seed: of everything random.
        quantities: methods whose members are read out.
        keep_members: the file to which the ensemble's are written.
        processes: that share the run.
    """

    measured: geometry.Recording
    prepared: PreparedMeasurement
    models: Models
    methods: Sequence[str]
    also: Sequence[geometry.Recording]
    members: int
    options: EnsembleOptions
    truth: geometry.Recording | None
    checkpoints: Path | None
    resume: bool | Saved
    seed: int
    quantities: Collection[str]
    keep_members: Path | None
    processes: int = 1

    def for_worker(self) -> MethodsRun:
        """The same run as another process is told of it: it makes its own simulators, and reads no checkpoint."""
        return replace(self, models=self.models.anew(), resume=bool(self.resume))

    def refuse_foreign_checkpoint(self) -> None:
        """Tell another run's checkpoint before splines and free runs have taken their minutes."""
        if "ensemble" not in self.methods or not isinstance(self.resume, Saved):
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

    def results(self, watcher: Watcher | None = None, progress: bool = False) -> dict[str, MethodResult]:
        """What each method makes of the measurement, in the order of ``METHODS``; complete in the first process."""
        timer, smoothed = _Timer(), self.prepared.smoothed  # by all processes together
        summary, results = self.prepared.splines.estimates.summary(), {}
        account: dict[str, Any] = {"estimates": summary} if summary else {}
        if self.processes > 1:
            account["processes"] = self.processes
        if "spline" in self.methods:
            drawn = self._drawn() if "spline" in self.quantities and is_lead() else None
            told = {"smoother": repr(self.prepared.splines.smoother)} | account
            results["spline"] = timer.result(with_pressure(smoothed, drawn), told, drawn)
        if is_last() and set(self.methods) != {"spline"}:
            free = run_freely(
                self.measured, self.models.coarse, smoothed.velocity[0], seed=self.seed, progress=progress
            )
            results["free"] = timer.result(free)
        if is_lead() and "sph" in self.methods:
            run = filter_sph(self.prepared, self.models.coarse, seed=self.seed, progress=progress)
            results["sph"] = timer.result(run.recording, run.info)
        if "ensemble" in self.methods:
            done, curves = self._ensemble(watcher, progress)
            results["ensemble"] = timer.result(with_pressure(done.recording, curves), done.info | account, curves)
        free_run = from_last(results.get("free"))
        known = results if free_run is None else results | {"free": free_run}
        return {name: known[name] for name in METHODS if name in known}

    def _ensemble(self, watcher: Watcher | None, progress: bool) -> tuple[EnsembleRun, MemberCurves | None]:
        """The ensemble's analyses, and what its members give where it is asked for."""
        wanted = "ensemble" in self.quantities
        quantities = MemberQuantities(self.prepared.recording, strict=False) if wanted else None
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

    def _drawn(self) -> MemberCurves:
        """What draws from the splines' posterior give."""
        prepared, count, seed = self.prepared, self.members, self.seed
        amplitude = Amplitude(prepared.balance, prepared.amplitude_error, count, seed)
        frames = spline_frames(prepared.splines, prepared.smoothed, count, seed=seed, amplitude=amplitude)
        return quantified(prepared.smoothed, frames)


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
