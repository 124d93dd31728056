"""The one picture: error against seconds of forecasts and analyses, for presets, methods and rivals; best ones marked.

    python examples/error_seconds.py [--measure] [--out error_seconds.png]

Drawn from results that are in the checkout: `benchmarks/results/speed_error.json` (schemes and steps),
`filter_methods_*.json` (methods of torchsph), `rivals/results/rivals.json` and, for presets, spacings, precisions and
backends, `error_seconds.json` beside them, which `--measure` makes: row by row, those that the present code has made
are kept. A black line joins what nothing else beats in error and seconds at once (the Pareto front). Seconds are CPU
seconds of one thread.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib

matplotlib.use("Agg")
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

import geometry
import torchsph as ts
from examples.provenance import MODEL, stale, write_table
from torchsph.data import sample_truth

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "benchmarks" / "results"
OWN, RIVALS = RESULTS / "error_seconds.json", HERE / "rivals" / "results" / "rivals.json"
INPUTS = (
    RESULTS / "speed_error.json",
    RESULTS / "filter_methods_measured.json",
    RESULTS / "filter_methods_noisy.json",
    OWN,
    RIVALS,
)
SOURCES = ("examples/error_seconds.py", "torchsph/methods/forecast_skill.py", *MODEL)
LEADS = (0.01, 0.02, 0.04)  # s
ROWS = {  # name -> preset, spacing (mm), precision, backend
    "default, 3 mm": ("default", 3.0, torch.float32, "auto"),
    "default, 2 mm": ("default", 2.0, torch.float32, "auto"),
    "default, 2 mm, float64": ("default", 2.0, torch.float64, "auto"),
    "default, 2 mm, reference backend": ("default", 2.0, torch.float32, "reference"),
    "weakly compressible, 2 mm": ("weakly_compressible", 2.0, torch.float32, "auto"),
    "thesis, 2 mm": ("thesis", 2.0, torch.float32, "auto"),
}


@dataclass(frozen=True)
class Point:
    """A method: its name, seconds, error, and the group that colours it."""

    name: str
    seconds: float
    error: float
    group: str


def measured(preset: str, spacing: float, dtype: torch.dtype, backend: str) -> dict[str, float]:
    """Error over persistence's of forecasts of the sample, mean over the leads, and CPU seconds."""
    recording = geometry.read_recording(str(sample_truth()))
    scene = ts.Scene.from_recording(recording, 1e-3 * spacing)
    model = ts.Simulator(scene, ts.preset(preset), dtype=dtype, backend=backend)
    model.domain.prepare_until(float(recording.time[0]), float(recording.time[-1]))
    began = time.process_time()
    found = ts.skill(recording, model, LEADS, every=recording.frames // 8)
    ratios = [row["nrmse"]["model"] / row["nrmse"]["persistence"] for row in found.leads]
    return {"error": sum(ratios) / len(ratios), "cpu_s": time.process_time() - began}


def own_rows() -> dict[str, dict[str, float]]:
    """The rows that `--measure` has made."""
    return json.loads(OWN.read_text(encoding="utf-8"))["rows"] if OWN.is_file() else {}


def measure() -> None:
    """Make the rows that are missing, all of them where code has changed since."""
    current = OWN.is_file() and not stale(json.loads(OWN.read_text(encoding="utf-8")))
    rows = own_rows() if current else {}
    for name, options in ROWS.items():
        if name not in rows:
            rows[name] = measured(*options)
            write_table(OWN, {"rows": rows}, SOURCES)
            print(f"{name}: {rows[name]['error']:.3f} in {rows[name]['cpu_s']:.1f} s", file=sys.stderr)


def forecasts() -> list[Point]:
    """Points of the left panel."""
    points = [
        Point(f"{row['curve']}, {row['resolution']:g} mm", row["cpu_s"], row["error"], row["curve"].split(",")[0])
        for row in json.loads(INPUTS[0].read_text(encoding="utf-8"))["rows"]
        if row["flow"] == "ventricle"
    ]
    return points + [Point(name, row["cpu_s"], row["error"], name.split(",")[0]) for name, row in own_rows().items()]


def analyses(noise: str) -> list[Point]:
    """Points of a panel for one level of noise: methods of torchsph, and rivals."""
    table = json.loads((RESULTS / f"filter_methods_{noise}.json").read_text(encoding="utf-8"))["rows"]
    left_out = ("raw", "raw over time", "spline over time")  # no seconds of their own
    own = [Point(name, row["seconds"], row["nrmse"], "torchsph") for name, row in table.items() if name not in left_out]
    rows = json.loads(RIVALS.read_text(encoding="utf-8"))["rows"].get(noise, {}) if RIVALS.is_file() else {}
    others = {name: row for name, row in rows.items() if name not in ("raw", "spline", "ensemble")}
    groups = {name: "torchsph" if name == "spline over time" else "rival" for name in others}
    return own + [Point(name, row["seconds"], row["nrmse"], groups[name]) for name, row in others.items()]


def front(points: list[Point]) -> list[Point]:
    """What no other point beats in both, from the quickest to the most accurate."""
    best: list[Point] = []
    for point in sorted(points, key=lambda each: (each.seconds, each.error)):
        if not best or point.error < best[-1].error:
            best.append(point)
    return best


def panel(axis: Axes, points: list[Point], title: str, label: str) -> None:
    """Points with the names of those of the front and, where there are few, of all; a colour for each group."""
    groups = list(dict.fromkeys(point.group for point in points))
    for number, group in enumerate(groups):
        mine = [point for point in points if point.group == group]
        colour = f"C{number}"
        axis.plot([p.seconds for p in mine], [p.error for p in mine], "o", color=colour, label=group, markersize=5)
    best = front(points)
    axis.step([p.seconds for p in best], [p.error for p in best], "k-", where="post", linewidth=0.8, zorder=0)
    named = (
        points if len(points) < 18 else [p for p, after in zip(best, [*best[1:], None], strict=True) if apart(p, after)]
    )
    for point in named:
        above = all(
            other is point or abs(other.error - point.error) > 0.01 or other.error < point.error for other in points
        )
        name = point.name.removeprefix(f"{point.group}, ")
        place, side = ((4, 3), "bottom") if above else ((4, -3), "top")
        axis.annotate(name, (point.seconds, point.error), place, textcoords="offset points", fontsize=7, va=side)
    axis.set(xscale="log", xlabel="CPU seconds", ylabel=label, title=title)
    axis.margins(x=0.25, y=0.1)
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(which="both", alpha=0.25)
    axis.legend(fontsize=7, framealpha=0.5)


def apart(point: Point, after: Point | None) -> bool:
    """Whether the next point of a front leaves room for this one's name."""
    return after is None or point.error - after.error > 0.02


def inputs_hash() -> str:
    """Hash of the results that the picture is drawn from: a test compares it with what the picture says."""
    digest = hashlib.sha256()
    for file in INPUTS:
        digest.update(file.read_bytes() if file.is_file() else b"")
    return digest.hexdigest()[:16]


def main() -> None:
    """Measure what is asked for, draw, and note what was drawn from."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measure", action="store_true", help="make the missing rows of presets and spacings first")
    parser.add_argument("--out", type=Path, default=HERE / "error_seconds.png")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.measure:
        measure()
    figure, axes = plt.subplots(1, 3, figsize=(14, 5), layout="constrained")
    panel(axes[0], forecasts(), "forecasts 10 to 40 ms ahead, sample", "error / error of persistence")
    for axis, noise in zip(axes[1:], ("measured", "noisy"), strict=True):
        panel(axis, analyses(noise), f"analyses of 44 frames, {noise} phantom", "error / RMS speed")
    figure.savefig(options.out, dpi=85, metadata={"Comment": inputs_hash()})
    names = {"forecast": forecasts(), "measured": analyses("measured"), "noisy": analyses("noisy")}
    for panel_name, points in names.items():
        print(f"{panel_name}: " + ", ".join(f"{p.name} ({p.seconds:.2g} s, {p.error:.3f})" for p in front(points)))


if __name__ == "__main__":
    main()
