"""The pictures that a run leaves behind: `report.png` of an assimilation, `forecast.png` of a forecast.

`draw_report` shows the cut through both valves (truth where given, measurement, each analysis) at frames that
share the motion evenly, the error over time with the times at which the valves are open, and the measures as
a table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np

import geometry

matplotlib.use("Agg")  # no screen is needed, and none is asked for
from matplotlib import pyplot as plt  # noqa: E402
from matplotlib.collections import LineCollection, QuadMesh  # noqa: E402

from . import slices  # noqa: E402
from .frames import matching_frames  # noqa: E402
from .metrics import UNITS, filled_velocity  # noqa: E402
from .scores import Scores  # noqa: E402

__all__ = ["characteristic_frames", "draw_forecast", "draw_report", "scores_table"]

COLUMNS = 5
NOT_CLINICAL = "for research, not for clinical use"
COLOURS = ("0.45", "tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple")
HEADINGS = {
    "nrmse": "nrmse",
    "vnrmse": "vnrmse",
    "magnitude_nrmse": "magnitude",
    "direction_error_deg": "angle deg",
    "divergence_rms": "div 1/s",
    "wall_normal_rms": "wall m/s",
    "flow_rate_error": "flow rate",
    "residual_rms": "residual m/s",
}


@dataclass(frozen=True)
class Row:
    """One row of pictures: what it is called, and the frames that it shows."""

    name: str
    recording: geometry.Recording


def draw_report(
    path: str | Path,
    measured: geometry.Recording,
    analyses: Mapping[str, geometry.Recording],
    scores: Mapping[str, Scores],
    truth: geometry.Recording | None = None,
    seconds: Mapping[str, float] | None = None,
) -> None:
    """Write `report.png`; `scores` has a row `raw` for the measurement beside one for each analysis."""
    named = {"raw": measured, **analyses}
    if truth is not None:
        truth = truth.select(matching_frames(measured.time, truth.time, "the truth"))
        named = {"truth": truth, **named}
    frames = characteristic_frames(measured if truth is None else truth)
    rows = [Row(name, recording.select(frames)) for name, recording in named.items()]
    heights = [2.3 * len(rows), 2.5, 0.6 + 0.25 * len(scores)]
    figure = plt.figure(figsize=(9, sum(heights)), layout="constrained")
    pictures, curves, table = np.asarray(figure.subfigures(3, 1, height_ratios=heights))
    _draw_cuts(pictures, rows, slices.valve_plane(measured))
    _draw_curves(curves.subplots(), measured, truth, scores)
    _draw_table(table.subplots(), scores, seconds or {})
    figure.text(0.995, 0.002, NOT_CLINICAL, fontsize=7, color="0.4", ha="right", va="bottom")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def characteristic_frames(recording: geometry.Recording, count: int = COLUMNS) -> np.ndarray:
    """Frames that share the recording's motion (RMS speed summed over time) evenly: in order, no repeats."""
    velocity = filled_velocity(recording).reshape(len(recording.time), -1)
    motion = np.sqrt(np.mean(velocity.astype(np.float64) ** 2, axis=1))
    share = np.cumsum(motion + 1e-12)
    wanted = (np.arange(count) + 0.5) / count * share[-1]
    return np.unique(np.searchsorted(share, wanted).clip(0, len(share) - 1))


def _draw_cuts(figure: matplotlib.figure.SubFigure, rows: Sequence[Row], plane: slices.Plane) -> None:
    step, times = float(min(rows[0].recording.grid.spacing)), rows[0].recording.time
    axes = figure.subplots(len(rows), len(times), squeeze=False, sharex=True, sharey=True)
    cuts = [_cuts_of(row.recording, plane, 0.25 * step) for row in rows]
    # The first row is the truth where there is one: outliers of the measurement must not set the colours.
    top = max(float(np.nanmax(c.speed, initial=1e-6)) for c in cuts[0])
    for row, line, row_cuts in zip(rows, axes, cuts, strict=True):
        line[0].set_ylabel(row.name, fontsize=11)
        for axis, picture in zip(line, row_cuts, strict=True):
            image = _draw_cut(axis, picture, top, arrows=2 * step)
    for axis, time in zip(axes[0], times, strict=True):
        axis.set_title(f"{1e3 * time:.0f} ms", fontsize=10)
    figure.colorbar(image, ax=axes, shrink=0.5, label="speed, m/s", extend="max")
    figure.suptitle("cut through the valves and the long axis, mm", fontsize=11)


def _cuts_of(recording: geometry.Recording, plane: slices.Plane, pixel: float) -> list[slices.Cut]:
    velocity = filled_velocity(recording)
    return [slices.cut(recording, velocity[f], f, plane, pixel) for f in range(len(recording.time))]


def _draw_cut(axis: matplotlib.axes.Axes, picture: slices.Cut, top: float, arrows: float) -> QuadMesh:
    mm = 1e3
    image = axis.pcolormesh(
        mm * picture.across,
        mm * picture.along,
        picture.speed,
        cmap="viridis",
        vmin=0,
        vmax=top,
        rasterized=True,
    )
    step = max(1, round(arrows / float(picture.across[1] - picture.across[0])))
    thin = (slice(step // 2, None, step),) * 2
    s, t = np.meshgrid(mm * picture.across, mm * picture.along)
    axis.quiver(
        s[thin],
        t[thin],
        picture.velocity[0][thin],
        picture.velocity[1][thin],
        color="white",
        angles="xy",
        scale=8 * top,
        width=0.006,
    )
    axis.add_collection(LineCollection(list(mm * picture.outline), colors="0.2", linewidths=1.0))
    axis.set_aspect("equal")
    axis.tick_params(labelsize=7)
    return image


def _draw_curves(
    axis: matplotlib.axes.Axes,
    measured: geometry.Recording,
    truth: geometry.Recording | None,
    scores: Mapping[str, Scores],
) -> None:
    metric, label = "divergence_rms", "RMS divergence, 1/s"
    if truth is not None:
        metric, label = "nrmse", "RMS error / RMS true speed"
    time = 1e3 * np.asarray(measured.time)
    for (name, score), colour in zip(scores.items(), COLOURS * len(scores), strict=False):
        values = np.array(score[metric].per_frame, float)
        axis.plot(time, values, "o-", color=colour, markersize=3, linewidth=1.4, label=name)
    for shade, (region, opening, closing) in enumerate(measured.valve_intervals_or_derived()):
        start, end = max(1e3 * opening, time[0]), min(1e3 * closing, time[-1])
        if end > start:
            axis.axvspan(start, end, color=("tab:blue", "tab:red")[shade % 2], alpha=0.07, lw=0)
            axis.text(
                0.5 * (start + end),
                0.97,
                f"orifice {int(region)} open",
                ha="center",
                va="top",
                transform=axis.get_xaxis_transform(),
                fontsize=8,
                color="0.4",
            )
    axis.set(xlabel="time, ms", ylabel=label, ylim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _draw_table(axis: matplotlib.axes.Axes, scores: Mapping[str, Scores], seconds: Mapping[str, float]) -> None:
    heading, *rows = scores_table(scores, seconds)
    axis.axis("off")
    table = axis.table(
        [row[1:] for row in rows],
        rowLabels=[row[0] for row in rows],
        colLabels=heading[1:],
        loc="center",
        cellLoc="right",
    )
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    table.scale(1, 1.3)


def scores_table(scores: Mapping[str, Scores], seconds: Mapping[str, float]) -> list[list[str]]:
    """Heading and one row of text per method; a measure nobody has is left out, a missing one is a dash."""
    present = [name for name in UNITS if any(name in score for score in scores.values())]
    table = [["method", *(HEADINGS[name] for name in present), "seconds"]]
    for method, score in scores.items():
        values = [score[name].value if name in score else None for name in present]
        table.append([method, *map(_short, values), _short(seconds.get(method))])
    return table


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def draw_forecast(path: str | Path, leads: Sequence[Mapping]) -> None:
    """Write `forecast.png`: error against lead time of the model and of persistence."""
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    times = [1e3 * row["lead"] for row in leads]
    for name, colour in (("persistence", "0.45"), ("model", "tab:blue")):
        axis.plot(times, [row["nrmse"][name] for row in leads], "o-", color=colour, label=name)
    axis.set(xlabel="lead, ms", ylabel="RMS error / RMS true speed", ylim=(0, None), xlim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
