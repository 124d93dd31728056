"""A picture of a filter's account: is it as wrong as it says, where, and since when?"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def filter_figure(summary: dict) -> Figure:
    """Four panels from `FilterRecord.summary()`: spread and skill over time, rank histogram, normalised
    innovations per region, and observations used and rejected. Without a truth the first shows spread only.

    Returns a matplotlib figure that belongs to no window; `figure.savefig(path)` writes it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    _spread(axes[0, 0], summary["cycles"])
    _ranks(axes[0, 1], summary["rank_histogram"])
    _innovations(axes[1, 0], summary["cycles"])
    _observations(axes[1, 1], summary["cycles"])
    if summary["warnings"]:
        figure.suptitle("\n".join(summary["warnings"]), fontsize=9, color="firebrick")
    return figure


def _spread(axes: Axes, cycles: list[dict]) -> None:
    time = [cycle["time"] for cycle in cycles]
    axes.plot(time, [cycle["spread_before"] for cycle in cycles], color="C0", label="spread, forecast")
    axes.plot(time, [cycle["spread_after"] for cycle in cycles], color="C0", ls="--", label="spread, analysis")
    known = [cycle for cycle in cycles if "error" in cycle]
    if known:
        axes.plot(
            [cycle["time"] for cycle in known],
            [cycle["error"] for cycle in known],
            color="C3",
            label="error, forecast",
        )
    axes.set(xlabel="time (s)", ylabel="RMS (unit of the state)", ylim=(0, None))
    axes.legend(fontsize=8)


def _ranks(axes: Axes, counts: list[int] | None) -> None:
    if counts is None:
        axes.text(0.5, 0.5, "no truth: no ranks", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    total = sum(counts)
    axes.bar(range(len(counts)), [count / total for count in counts], width=0.9, color="C7")
    axes.axhline(1 / len(counts), color="k", lw=1)
    axes.set(xlabel="rank of the truth among the members", ylabel="share")


def _innovations(axes: Axes, cycles: list[dict]) -> None:
    for name in cycles[0]["innovations"] if cycles else ():
        ratios = [cycle["innovations"][name]["ratio"] for cycle in cycles]
        shown = [math.nan if ratio is None else ratio for ratio in ratios]
        axes.plot([cycle["time"] for cycle in cycles], shown, label=name, marker=".", ms=3)
    axes.axhline(1, color="k", lw=1)
    axes.set(xlabel="time (s)", ylabel="RMS of normalised innovations", ylim=(0, None))
    if axes.lines[1:]:
        axes.legend(fontsize=8)


def _observations(axes: Axes, cycles: list[dict]) -> None:
    time = [cycle["time"] for cycle in cycles]
    names = sorted({name for cycle in cycles for name in cycle["observations"]})
    for name in names:
        counts = [cycle["observations"].get(name, 0) for cycle in cycles]
        axes.plot(time, counts, label=name.replace("_", " "), marker=".", ms=3)
    axes.set(xlabel="time (s)", ylabel="observations", yscale="symlog", ylim=(0, None))
    if names:
        axes.legend(fontsize=8)
