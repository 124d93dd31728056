"""Several methods on one measurement, one after another: what every process of a run does, each its part."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import geometry

from .ensemble.assimilate import EnsembleRun, assimilate, default_filter, further
from .ensemble.identity import ensemble_key
from .ensemble.options import EnsembleOptions
from .free_run import run_freely
from .measurement.error_model import ObservationError
from .measurement.prepared import PreparedMeasurement
from .members.amplitude import Amplitude
from .members.draws import spline_frames
from .members.frames import FrameObserver
from .members.kept import MemberFile
from .members.quantities import MemberCurves, MemberQuantities, quantified, with_pressure
from .members.resolution import Resolution
from .models import Models
from .nudging import filter_sph
from .runtime.checkpoint import Saved
from .runtime.parallel import is_lead, processes, shared
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
        before = timer.passed()
        results |= self._single_runs(smoothed, 0.0 if "spline" in self.methods else before, progress)
        timer.passed()
        if "ensemble" in self.methods:
            done, curves = self._ensemble(watcher, progress)
            results["ensemble"] = timer.result(with_pressure(done.recording, curves), done.info | account, curves)
        return {name: results[name] for name in METHODS if name in results}

    def _single_runs(self, smoothed: geometry.Recording, before: float, progress: bool) -> dict[str, MethodResult]:
        """The runs of one member and the error model, shared among the processes.

        Args:
            smoothed: the splines.
            before: seconds that went into them, where no result of theirs counts them.
            progress: show bars.
        """
        prepared, coarse = self.prepared, partial(getattr, self.models, "coarse")

        def free() -> MethodResult:
            timer = _Timer()
            run = run_freely(self.measured, coarse(), smoothed.velocity[0], seed=self.seed, progress=progress)
            found = timer.result(run)
            return replace(found, seconds=found.seconds + before)

        def nudged() -> MethodResult:
            timer, run = _Timer(), filter_sph(prepared, coarse(), seed=self.seed, progress=progress)
            return timer.result(run.recording, run.info)

        tasks: dict[str, Callable[[], MethodResult | ObservationError]] = {}
        if processes() > 1 and {"sph", "ensemble"} & set(self.methods):  # one alone makes it when it is asked for
            tasks["error"] = lambda: prepared.error
        if "sph" in self.methods:
            tasks["sph"] = nudged
        if set(self.methods) != {"spline"}:
            tasks["free"] = free
        found = dict(zip(tasks, shared(list(tasks.values())), strict=True))
        for one in found.values():
            if isinstance(one, ObservationError):
                prepared.__dict__["error"] = one  # where the cached property keeps it
        return {name: one for name, one in found.items() if isinstance(one, MethodResult)}

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
        resolution = Resolution.of(prepared.recording, prepared.balance, prepared.error.kernel)
        frames = spline_frames(
            prepared.splines, prepared.smoothed, count, seed=seed, amplitude=amplitude, resolution=resolution
        )
        return quantified(prepared.smoothed, frames)


class _Timer:
    """Seconds between the results of one run after another."""

    def __init__(self) -> None:
        self.began = clock.perf_counter()

    def passed(self) -> float:
        """Seconds since the last result, which no result counts."""
        ended = clock.perf_counter()
        passed, self.began = ended - self.began, ended
        return passed

    def result(
        self,
        recording: geometry.Recording,
        info: dict[str, Any] | None = None,
        quantities: MemberCurves | None = None,
    ) -> MethodResult:
        return MethodResult(recording, self.passed(), {} if info is None else info, quantities)
