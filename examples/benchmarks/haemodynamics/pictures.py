"""Pressure and pathlines of an analysis beside the truth's, in a plane through both valves.

    torchsph assimilate MEASURED.h5 --out RUN
    python examples/benchmarks/haemodynamics/pictures.py TRUTH.h5 RUN/ensemble.h5 [--out results]

`pressure.png`: mid-ejection, the E wave and the A wave, each truth, analysis and their difference, with the mean of
every picture set to 0. `pathlines.png`: the same tracers from the base at the opening of the inlet, as far as the end
of the recording, coloured by time.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import matplotlib
import numpy as np
import torch

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import geometry
from examples.figures.style import save
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics.lagrangian.moving_flow import MovingFlow, MovingWalls
from torchsph.haemodynamics.lagrangian.tracers import carry, seed_blood

MM = 1e3
TRACERS = 400  # in all of the blood; a third of them starts near the base


def moments(recording: geometry.Recording) -> dict[str, int]:
    """Frames of the fastest ejection and of the fastest early and late filling, by dV/dt of the walls."""
    motion = geometry.WallMotion.from_recording(recording)
    rate = np.array([motion.volume_rate(float(t)) for t in recording.time])
    filling = np.flatnonzero(rate > 0.1 * rate.max())
    early, late = np.array_split(filling, 2)
    return {
        "ejection": int(rate.argmin()),
        "early filling": int(early[rate[early].argmax()]),
        "late filling": int(late[rate[late].argmax()]),
    }


def cut(recording: geometry.Recording, field: np.ndarray, frame: int, row: int) -> np.ndarray:
    """A field (*shape) in the plane y = row less its mean over the blood of the frame, nan outside."""
    mask = np.asarray(recording.mask[frame], bool)
    return np.where(mask, field - field[mask].mean(), np.nan)[:, row]


def draw_pressure(truth: geometry.Recording, analysis: geometry.Recording, path: Path) -> None:
    """Three moments, one in a row: truth, analysis, difference."""
    if truth.pressure is None or analysis.pressure is None:
        sys.exit("both recordings need /pressure: it is written where the ensemble's quantities are read out")
    grid, chosen = analysis.grid, moments(analysis)
    pairs = dict(zip(range(analysis.frames), matching_frames(analysis.time, truth.time, "the truth"), strict=True))
    row = grid.shape[1] // 2
    x, z = (MM * (grid.origin[a] + grid.spacing[a] * np.arange(grid.shape[2 - a])) for a in (0, 2))
    figure, axes = plt.subplots(len(chosen), 3, figsize=(8.2, 10.5), layout="constrained", sharex=True, sharey=True)
    for line, (name, frame) in zip(axes, chosen.items(), strict=True):
        right = cut(truth, np.asarray(truth.pressure[pairs[frame]], np.float64), int(pairs[frame]), row)
        found = cut(analysis, np.asarray(analysis.pressure[frame], np.float64), frame, row)
        top = float(np.nanquantile(np.abs(right), 0.98))
        for axis, picture, title in zip(
            line, (right, found, found - right), ("truth", "analysis", "less truth"), strict=True
        ):
            shown = axis.pcolormesh(x, z, picture, cmap="RdBu_r", vmin=-top, vmax=top, shading="nearest")
            axis.set_aspect("equal")
            axis.set_title(f"{title}, {name}, {MM * analysis.time[frame]:.0f} ms", fontsize=9)
        line[0].set_ylabel("z, mm")
        figure.colorbar(shown, ax=line, label="Pa", shrink=0.85)
    for axis in axes[-1]:
        axis.set_xlabel("x, mm")
    figure.suptitle("pressure less its mean", fontsize=11)
    save(figure, path)


def paths_of(recording: geometry.Recording, walls: MovingWalls, seeds: torch.Tensor, times: np.ndarray) -> np.ndarray:
    """(K, n, 3), m: where tracers from `seeds` are at `times`."""
    valves = recording.valve_intervals_or_derived()[:, 1:]
    flow = MovingFlow(
        recording.grid,
        recording.time,
        np.nan_to_num(filled_velocity(recording)),
        recording.mask,
        events=[float(t) for t in np.unique(valves) if np.isfinite(t)],
    )
    return carry(flow, seeds, float(times[0]), float(times[-1]), walls=walls, keep=times).paths.numpy()


def draw_paths(truth: geometry.Recording, analysis: geometry.Recording, path: Path) -> None:
    """Pathlines of the filling in the truth and in the analysis, seen along y, and how far they end apart."""
    inlet = next(float(opens) for label, opens, _ in analysis.valve_intervals_or_derived() if int(label) == 1)
    times = analysis.time[analysis.time >= inlet]
    first = int(np.flatnonzero(analysis.time >= inlet)[0])
    seeds = seed_blood(analysis.grid, analysis.mask[first], TRACERS, torch.Generator().manual_seed(0))
    seeds = seeds[seeds[:, 2] > seeds[:, 2].quantile(2 / 3)]
    walls = MovingWalls.from_recording(truth)
    found = {name: paths_of(one, walls, seeds, times) for name, one in (("truth", truth), ("analysis", analysis))}
    figure, axes = plt.subplots(1, 2, figsize=(8.2, 6.4), layout="constrained", sharex=True, sharey=True)
    outline = MM * analysis.wall_for("a picture").at(analysis.frames - 1).vertices
    for axis, (name, places) in zip(axes, found.items(), strict=True):
        lines = MM * np.stack([places[:-1], places[1:]], axis=2)[..., [0, 2]].reshape(-1, 2, 2)
        colours = np.repeat(MM * times[:-1], places.shape[1])
        shown = axis.add_collection(LineCollection(lines, array=colours, cmap="viridis", linewidths=0.7))
        axis.plot(MM * places[-1][:, 0], MM * places[-1][:, 2], ".", color="k", ms=2)
        axis.plot(outline[:, 0], outline[:, 2], ",", color="0.7", zorder=0)
        axis.set_aspect("equal")
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("x, mm")
    axes[0].set_ylabel("z, mm")
    figure.colorbar(shown, ax=axes, label="ms", shrink=0.8)
    apart = MM * np.linalg.norm(found["truth"] - found["analysis"], axis=2)
    spans = f"apart at {MM * times[len(times) // 2]:.0f} ms: {np.median(apart[len(times) // 2]):.1f} mm (median), "
    figure.suptitle(
        f"{len(seeds)} tracers from the base, from {MM * inlet:.0f} ms; {spans}at the end {np.median(apart[-1]):.1f} mm"
    )
    save(figure, path)


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("analysis", type=Path)
    parser.add_argument("--out", type=Path, default=Path())
    options = parser.parse_args()
    torch.set_num_threads(1)
    truth, analysis = (geometry.read_recording(path) for path in (options.truth, options.analysis))
    options.out.mkdir(parents=True, exist_ok=True)
    draw_pressure(truth, analysis, options.out / "pressure.png")
    draw_paths(truth, analysis, options.out / "pathlines.png")


if __name__ == "__main__":
    main()
