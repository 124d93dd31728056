"""Speckle tracking of a ventricle's echoes: figures 4.4 and 4.5 of the thesis, calibration, and the whole loop.

    python examples/benchmarks/ultrasound/tracking_phantom.py TRUE.h5 [--first F --last F --every K] [--loop]
        [--out FOLDER]
        [--json FILE] [--quick]

TRUE.h5: a recording of the true flow, which neither tracker nor calibration has seen. Its echoes are simulated
and tracked as `torchsph measure --mode speckle` does; the estimates are drawn in two planes through the long
axis, at right angles, below the truth, and their errors below them; z-scores with the fitted sigma are listed by
third of the weight. With --loop the measurement goes through `torchsph assimilate`'s spline and ensemble.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.ndimage import binary_erosion
from tracking import terciles

import geometry
from examples.provenance import ANALYSES, write_table
from torchsph.evaluation import metrics, slices
from torchsph.methods import by_name as pipeline
from torchsph.ultrasound import SpeckleOptions, measure_speckle

SOURCES = ("examples/benchmarks/ultrasound/tracking_phantom.py", "torchsph/ultrasound", *ANALYSES)

COLUMNS = 9


def calibration(measured: geometry.Recording, true: geometry.Recording) -> dict:
    """Errors and z-scores where something was measured: everywhere, and two nodes or more from the wall."""
    rows = {}
    deep = np.stack([binary_erosion(mask, np.ones((5,) * mask.ndim, bool)) for mask in measured.mask])
    for name, place in (("everywhere", measured.mask), ("inside", deep)):
        seen = place & (measured.weight > 0)
        error = (measured.velocity - true.velocity).transpose(0, 2, 3, 4, 1)[seen]
        score = error / measured.sigma.transpose(0, 2, 3, 4, 1)[seen]
        weight = torch.from_numpy(measured.weight[seen])
        rows[name] = {
            "accepted": round(float(seen.sum() / place.sum()), 3),
            "points": int(seen.sum()),
            "bias": error.mean(0).round(4).tolist(),
            "std": error.std(0).round(4).tolist(),
            "median": np.median(np.abs(error), axis=0).round(4).tolist(),
            "outliers": round(float((np.linalg.norm(error, axis=1) > 0.3).mean()), 4),
            "z-scores by third of the weight": terciles(torch.from_numpy(score), weight),
        }
    return rows


def loop(measured: geometry.Recording, true: geometry.Recording, seed: int, members: int | None) -> dict:
    """Scores against the truth of the measurement itself, the spline and the ensemble."""
    results = pipeline.run_methods(measured, ("spline", "ensemble"), members=members, seed=seed, progress=True)
    recordings = {"raw": measured} | {name: result.recording for name, result in results.items()}
    rows = {}
    for name, recording in recordings.items():
        scores = metrics.evaluate(recording, true, measured)
        rows[name] = {key: round(score.value, 4) for key, score in scores.items() if score.value is not None}
        if name in results:
            rows[name]["seconds"] = round(results[name].seconds, 1)
    return rows


def draw(path: Path, true: geometry.Recording, measured: geometry.Recording, quarter: bool) -> None:
    """Speed and in-plane arrows of the truth and, below it, of the estimates and of their errors, frame by frame."""
    plane = slices.valve_plane(true)
    if quarter:
        plane = replace(plane, across=np.cross(plane.along, plane.across))
    shown = replace(measured, mask=measured.mask & (measured.weight > 0))
    rows = (
        ("true", true, true.velocity),
        ("tracked", shown, shown.velocity),
        ("error", shown, shown.velocity - true.velocity),
    )
    columns = min(COLUMNS, len(measured.time))
    lines = -(-len(measured.time) // columns)
    figure, axes = plt.subplots(3 * lines, columns, figsize=(1.45 * columns + 1, 6.6 * lines), squeeze=False)
    top = float(np.percentile(np.linalg.norm(true.velocity, axis=1)[true.mask], 99.7))
    for axis in axes.flat:
        axis.set_axis_off()
    for frame, moment in enumerate(measured.time):
        for row, (name, recording, field) in enumerate(rows):
            axis = axes[3 * (frame // columns) + row, frame % columns]
            picture = slices.cut(recording, field[frame], frame, plane, 0.5e-3)
            image = axis.pcolormesh(1e3 * picture.across, 1e3 * picture.along, picture.speed, vmin=0, vmax=top)
            every = (slice(None, None, 3),) * 2
            axis.quiver(
                1e3 * picture.across[::3],
                1e3 * picture.along[::3],
                *(part[every] for part in picture.velocity),
                color="white",
                scale=8 * top,
                width=6e-3,
            )
            for segment in picture.outline:
                axis.plot(*(1e3 * segment.T), "k", lw=0.8)
            axis.set_aspect("equal")
            axis.set_title(f"{name}, {1e3 * moment:.0f} ms", fontsize=7)
    figure.subplots_adjust(wspace=0.02, hspace=0.1)
    figure.colorbar(image, ax=axes, label="speed (m/s)", shrink=0.4, pad=0.01)
    figure.savefig(path, dpi=85, bbox_inches="tight")
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("true", type=Path, metavar="TRUE.h5")
    parser.add_argument("--every", type=int, default=10, metavar="K", help="each K-th frame (default: 10)")
    parser.add_argument("--first", type=int, default=0, metavar="F", help="first frame (default: 0)")
    parser.add_argument("--last", type=int, metavar="F", help="last frame")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--members", type=int, metavar="N", help="of the ensemble")
    parser.add_argument("--loop", action="store_true", help="spline and ensemble too")
    parser.add_argument("--measured", type=Path, metavar="M.h5", help="keep the measurement here, or take it from here")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw the figures into this folder")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here")
    parser.add_argument("--quick", action="store_true", help="two frames, small training")
    arguments = parser.parse_args()
    whole = geometry.read_recording(arguments.true)
    last = whole.frames - 1 if arguments.last is None else arguments.last
    frames = list(range(arguments.first, last + 1, arguments.every))
    options = SpeckleOptions()
    if arguments.quick:
        frames, options = frames[:2], replace(options, training=2)
    true, began = whole.select(frames), time.perf_counter()
    if arguments.measured and arguments.measured.is_file():
        measured = geometry.read_recording(arguments.measured)
    else:
        measured = measure_speckle(true, options, arguments.seed, progress=True)
        if arguments.measured:
            geometry.write_recording(arguments.measured, measured)
    results = {"description": measured.description, "frames": frames, "calibration": calibration(measured, true)}
    print(f"measured in {time.perf_counter() - began:.0f} s", json.dumps(results, indent=1), flush=True)
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        for quarter in (False, True):
            draw(arguments.out / f"tracking_phantom_{90 * quarter}.png", true, measured, quarter)
    if arguments.loop:
        results["loop"] = loop(measured, true, arguments.seed, arguments.members)
        print(json.dumps(results["loop"], indent=1))
    if arguments.json:
        write_table(arguments.json, results, SOURCES)


if __name__ == "__main__":
    main()
