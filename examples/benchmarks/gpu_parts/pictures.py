"""One picture of a report of ``gpu.py``."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw(report: dict[str, dict], device: str, path: Path) -> None:
    """Pair sums, steps beside other programs', members against real time, and the parts of a cycle."""
    figure, axes = plt.subplots(2, 2, figsize=(12, 8), constrained_layout=True)
    for axis, part, panel in zip(
        axes.flat, ("pairs", "steps", "members", "cycle"), (_pairs, _steps, _members, _cycle), strict=True
    ):
        rows = [row for row in report.get(part, {}).get("rows", []) if "error" not in row]
        axis.set_title(part)
        if rows:
            panel(axis, rows)
        else:
            axis.text(0.5, 0.5, "not measured", ha="center", transform=axis.transAxes)
    figure.suptitle(f"torchsph on {device}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _pairs(axis, rows: list[dict]) -> None:
    kept = [row for row in rows if "g_pairs_per_s" in row]
    names = [f"{row['work']}, {row['particles']:.3g}\n{row['neighbours']}, {row['precision']}" for row in kept]
    bars = axis.barh(range(len(kept)), [row["g_pairs_per_s"] for row in kept])
    axis.bar_label(bars, fmt="%.3g", padding=2, fontsize=7)
    axis.set_yticks(range(len(kept)), names, fontsize=6)
    axis.set_xlabel("10^9 pairs a second")


def _steps(axis, rows: list[dict]) -> None:
    kept = [row for row in rows if "ms_per_step" in row]
    names = [f"{row['flow']}\n{row['particles'] / 1e6:.3g} M particles" for row in kept]
    times = [row["ms_per_step"] for row in kept]
    for row in kept:
        for key in (key for key in row if key.endswith(" (ms)")):
            names.append(f"{key.removesuffix(' (ms)')}, dam break\nthe same spacing, H100 SXM")
            times.append(row[key])
    bars = axis.barh(range(len(times)), times)
    axis.bar_label(bars, fmt="%.3g", padding=2, fontsize=7)
    axis.set_yticks(range(len(times)), names, fontsize=6)
    axis.set_xlabel("ms a step")


def _members(axis, rows: list[dict]) -> None:
    kept = [row for row in rows if "of_real_time" in row]
    for spacing in sorted({row["spacing_mm"] for row in kept}):
        own = [row for row in kept if row["spacing_mm"] == spacing]
        axis.loglog(
            [row["members"] for row in own], [row["of_real_time"] for row in own], "o-", label=f"{spacing:g} mm"
        )
    axis.axhline(1.0, color="0.5", lw=0.8)
    axis.set(xlabel="members", ylabel="seconds of computing for a second of the beat")
    axis.legend()


def _cycle(axis, rows: list[dict]) -> None:
    for place, row in enumerate(rows):
        left = 0.0
        for name, value in row.items():
            if name.endswith(" (s)"):
                axis.barh(place, value, left=left, label=name.removesuffix(" (s)") if not place else None)
                left += value
                axis.set_prop_cycle(None) if name.startswith("all else") else None
    axis.set_yticks(range(len(rows)), [row["run"] for row in rows], fontsize=7)
    axis.set_xlabel("seconds a cycle")
    axis.legend(fontsize=7)
