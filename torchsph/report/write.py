"""`write_report`: all of a run in one page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

import geometry
from geometry.arguments import between, checked
from geometry.recordings.whole_file import write_whole
from torchsph.evaluation.figures import NOT_CLINICAL, scores_table
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.evaluation.scores import Scores

from .curves import beat_table, curves_of, measure_curves
from .document import page
from .pathlines import pathlines
from .planes import View, cut_fields, drawn_channels, outlines, views
from .quality import measurement_checks

LARGEST = 8_000_000
"""Bytes that a page must not exceed."""
FOR_PLANES = 5_000_000
"""Bytes of it for the planes: their pixels are made as large, and their frames as few, as that asks for."""
MOST_FRAMES = 120
TRACERS = 400
BYTES = 4 / 3 * 2  # of a number of 16 bits as text


@checked(tracers=between(0, 100_000))
def write_report(
    path: str | Path,
    analysis: geometry.Recording,
    measured: geometry.Recording | None = None,
    *,
    truth: geometry.Recording | None = None,
    name: str = "analysis",
    title: str = "Flow report",
    scores: Mapping[str, Scores] | None = None,
    seconds: Mapping[str, float] | None = None,
    quantities: Mapping[str, Any] | None = None,
    estimates: Mapping[str, Any] | None = None,
    account: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    tracers: int = TRACERS,
) -> int:
    """Write a self-contained page: planes over time, curves, pathlines, the measurement's quality, settings.

    The page asks nothing of any network. Recordings of more than `MOST_FRAMES` frames are shown at some of them, and
    large ones with coarser pixels, so that the page stays below `LARGEST` bytes; it says so.

    Args:
        path: of the page.
        analysis: the flow that is shown first, with `/sigma` and `/pressure` where it has them.
        measured: what it was made of, on the same grid and frames.
        truth: the true flow, with a frame at each of the analysis's times.
        name: of the method that made the analysis.
        title: of the page.
        scores: measures of each method (`torchsph.evaluation.metrics.evaluate`), for the table and the curves.
        seconds: that each method took.
        quantities: the document of `torchsph quantify`, with or without bands.
        estimates: what was mended of walls and valves (`geometry.Estimates.summary`).
        account: where the result comes from: versions, settings, inputs.
        notes: further sentences about the run, such as warnings.
        tracers: that are shown at a time; 0: no pathlines.

    Returns:
        The size of the page, bytes.

    Raises:
        ValueError: the measurement or the truth does not lie on the analysis's grid and frames, or the page would
            become too large.
    """
    sources = _sources(analysis, measured, truth, name)
    frames = _frames(analysis.frames)
    shown = views(analysis)
    pixel = _pixel(sources, shown, len(frames))
    chosen = {label: recording.select(frames) for label, recording in sources.items()}
    data: dict[str, Any] = {
        "title": title,
        "note": NOT_CLINICAL,
        "about": _about(analysis, name, frames, pixel),
        "time": [float(t) for t in analysis.time[frames]],
        "valves": _valves(analysis),
        "tops": _tops(chosen[name]),
        "planes": _planes(chosen, shown, pixel, chosen[name]),
        "curves": [
            curve.plain()
            for curve in [*curves_of(quantities or {}), *measure_curves(scores or {}, np.asarray(analysis.time))]
        ],
        "beat": beat_table(quantities or {}),
        "table": scores_table(scores, seconds or {}) if scores else [],
        "checks": []
        if measured is None
        else [asdict(check) for check in measurement_checks(measured, analysis, estimates)],
        "notes": list(notes),
        "account": _plain(account or {}),
        "paths": pathlines(chosen[name], tracers).packed() if tracers and len(frames) > 1 else None,
    }
    content = page(title, NOT_CLINICAL, json.dumps(data, allow_nan=False, separators=(",", ":")))
    if len(content) > LARGEST:
        raise ValueError(f"{path}: the page would have {len(content)} bytes, more than {LARGEST}; take fewer tracers")
    write_whole(path, content)
    return len(content)


def _sources(
    analysis: geometry.Recording, measured: geometry.Recording | None, truth: geometry.Recording | None, name: str
) -> dict[str, geometry.Recording]:
    """What is shown by its label, the analysis first."""
    found = {name: analysis}
    for label, other in (("measurement", measured), ("truth", truth)):
        if other is None:
            continue
        if other.grid.shape != analysis.grid.shape:
            raise ValueError(f"the {label} has a grid of {other.grid.shape} nodes, the analysis {analysis.grid.shape}")
        found[label] = other.select(matching_frames(analysis.time, other.time, f"the {label}"))
    return found


def _frames(count: int) -> np.ndarray:
    """The frames that are shown: all, or `MOST_FRAMES` evenly among them."""
    return np.unique(np.round(np.linspace(0, count - 1, min(count, MOST_FRAMES))).astype(int))


def _pixel(sources: Mapping[str, geometry.Recording], shown: Sequence[View], frames: int) -> float:
    """Side of a pixel, m: the grid's spacing, or as much more as `FOR_PLANES` asks for."""
    recordings = list(sources.values())
    numbers = sum(one.dimension + len(drawn_channels(one)) + 0.5 for one in recordings)  # known: a byte
    pixel = float(min(recordings[0].grid.spacing))
    while True:
        pixels = sum(len(s) * len(t) for s, t in (view.pixels(pixel) for view in shown))
        if BYTES * numbers * pixels * frames <= FOR_PLANES:
            return pixel
        pixel *= 1.1


def _planes(
    sources: Mapping[str, geometry.Recording], shown: Sequence[View], pixel: float, walls: geometry.Recording
) -> list[dict[str, Any]]:
    cuts = {label: cut_fields(recording, shown, pixel) for label, recording in sources.items()}
    planes = []
    for number, view in enumerate(shown):
        s, t = view.pixels(pixel)
        planes.append(
            {
                "name": view.name,
                "pixel": pixel,
                "corner": [float(s[0]), float(t[0])],
                "size": [len(s), len(t)],
                "axes": [[float(x) for x in axis] for axis in (view.plane.origin, view.plane.across, view.plane.along)],
                "outline": outlines(walls, view),
                "fields": {label: found[number] for label, found in cuts.items()},
            }
        )
    return planes


def _tops(analysis: geometry.Recording) -> dict[str, float]:
    """The largest value of each colour scale: the 99.5th hundredth of the analysis, so that no peak greys the rest."""
    inside = np.asarray(analysis.mask, bool)

    def high(values: np.ndarray) -> float:
        found = np.abs(values[np.isfinite(values)])
        return float(np.quantile(found, 0.995)) if found.size else 1.0

    speed = np.linalg.norm(filled_velocity(analysis), axis=1)[inside]
    tops = {"speed": high(speed)}
    if analysis.sigma is not None:
        tops["deviation"] = high(np.sqrt(np.square(analysis.sigma).sum(1))[inside])
    if analysis.pressure is not None:
        tops["pressure"] = high(analysis.pressure[inside])
    return tops


def _valves(recording: geometry.Recording) -> list[dict[str, float | int]]:
    """When each orifice is open, within the frames."""
    first, last = float(recording.time[0]), float(recording.time[-1])
    return [
        {"region": int(region), "opens": max(float(opens), first), "closes": min(float(closes), last)}
        for region, opens, closes in recording.valve_intervals_or_derived()
        if closes >= first and opens <= last
    ]


def _about(recording: geometry.Recording, name: str, frames: np.ndarray, pixel: float) -> list[str]:
    """What is shown, in sentences."""
    size = " x ".join(str(n) for n in reversed(recording.grid.shape))
    spacing = " x ".join(f"{1e3 * step:.3g}" for step in recording.grid.spacing)
    time = recording.time
    told = [
        f"{name}: {recording.frames} frames from {1e3 * time[0]:.4g} to {1e3 * time[-1]:.4g} ms, "
        f"{size} nodes, {spacing} mm apart.",
        f"The planes are drawn from {len(frames)} of {recording.frames} frames at points {1e3 * pixel:.3g} mm apart.",
    ]
    return [recording.description, *told] if recording.description else told


def _plain(value: Any) -> Any:
    """What JSON can hold: other things by their name, and no number that is not one."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and np.isfinite(value):
        return value
    return str(value)
