"""The pipeline that the command line calls: methods by name, with sensible sizes, each timed."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import geometry
import regularize

from .ensemble import assimilate
from .forecast import ForecastSkill, skill
from .observation_error import estimate_error
from .particle_filter import filter_sph
from .presets import preset as scheme_preset
from .scene import Scene
from .simulator import Simulator
from .smooth import FrameSmoother, smooth_frames

METHODS = ("spline", "sph", "ensemble")
# written to analysis.h5 and run when no method is named
DEFAULT_METHOD = "ensemble"
DEFAULT_MEMBERS = 16
# particle spacing of the analysing methods in grid spacings: a measurement blurred over several nodes does not hold
# what finer particles could carry
ANALYSIS_SPACING = 2.0


@dataclass(frozen=True)
class MethodResult:
    """What one method made of a measurement."""

    recording: geometry.Recording
    seconds: float
    info: dict[str, Any] = field(default_factory=dict)


def make_model(
    recording: geometry.Recording, *, preset: str = "default", spacing: float | None = None, device: str = "cpu"
) -> Simulator:
    """A simulator of the recording's walls and valves; ``spacing`` (m) defaults to the grid's."""
    return Simulator(Scene.from_recording(recording, spacing), scheme_preset(preset), device=device)


def run_methods(
    measured: geometry.Recording, methods: Sequence[str], *, preset: str = "default", spacing: float | None = None,
    members: int | None = None, seed: int = 0, device: str = "cpu", progress: bool = False,
) -> dict[str, MethodResult]:
    """Run methods by name on one measurement, in the order of ``METHODS``.

    ``spacing`` (m) defaults to ``ANALYSIS_SPACING`` grid spacings, ``members`` to ``DEFAULT_MEMBERS``. The seconds of
    "sph" and "ensemble" include the spline that they start from only where "spline" itself was not asked for.

    Raises ValueError for an unknown method.
    """
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ValueError(f"unknown method {', '.join(unknown)}; known: {', '.join(METHODS)}")
    smoother = regularize.Smoother.preset(preset)
    results: dict[str, MethodResult] = {}
    began = clock.perf_counter()
    splines = FrameSmoother(measured, smoother)
    smoothed = smooth_frames(splines, progress)
    if "spline" in methods:
        results["spline"] = MethodResult(smoothed, clock.perf_counter() - began, {"smoother": repr(smoother)})
        began = clock.perf_counter()
    if spacing is None:
        spacing = ANALYSIS_SPACING * min(measured.grid.spacing)
    model = make_model(measured, preset=preset, spacing=spacing, device=device)
    if "sph" in methods:
        error = estimate_error(measured, splines, smoothed)
        run = filter_sph(measured, model, error=error, seed=seed, progress=progress)
        results["sph"] = MethodResult(run.recording, clock.perf_counter() - began, run.info)
        began = clock.perf_counter()
    if "ensemble" in methods:
        count = DEFAULT_MEMBERS if members is None else members
        many = assimilate(
            measured, model, members=count, splines=splines, smoothed=smoothed, seed=seed, progress=progress
        )
        results["ensemble"] = MethodResult(many.recording, clock.perf_counter() - began, many.info)
    return results


def forecast_skill(
    recording: geometry.Recording, leads: Sequence[float], *, every: int = 1, preset: str = "default",
    spacing: float | None = None, device: str = "cpu", save: bool = False, progress: bool = False, seed: int = 0,
) -> ForecastSkill:
    """Skill of the simulator on a recording; see ``forecast.skill``. ``spacing`` (m) defaults to the grid's."""
    began = clock.perf_counter()
    model = make_model(recording, preset=preset, spacing=spacing, device=device)
    made = clock.perf_counter() - began
    result = skill(recording, model, leads, every=every, save=save, progress=progress, seed=seed)
    result.seconds["setup"] += made
    return result
