"""Forecasts of a ventricle beside the truth and the field they start from, in a plane through both valves.

    python examples/forecast_figure.py RECORDING.h5 [--lead 0.02] [--spacing 1e-3] [--out forecast.png]

One column for each of ejection, the E wave and the A wave, found from the volume's rate alone: the times of its most
negative value and of its two highest peaks. Rows: the start, the forecast one lead later, the truth then, and the
difference of the two. The relative error stands above each forecast, that of persistence beside it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from scipy.signal import find_peaks

import geometry
from torchsph import GridForecast, Scene, Simulator, Transfer, preset


def phases(recording: geometry.Recording, lead: float) -> dict[str, int]:
    """Frames from which a forecast of ``lead`` (s) ends in mid-ejection, at the E wave's and at the A wave's peak."""
    motion = geometry.WallMotion.from_recording(recording)
    last = int(np.searchsorted(recording.time, recording.time[-1] - lead - 1e-9))
    rate = np.array([motion.volume_rate(t + lead) for t in recording.time[:last]])
    peaks, _ = find_peaks(rate, height=0.1 * rate.max(), distance=5)
    filling = sorted(peaks[np.argsort(rate[peaks])[-2:]])
    return dict(zip(("E wave", "A wave"), filling, strict=False)) | {"ejection": int(rate.argmin())}


def plane_rows(recording: geometry.Recording) -> int:
    """Index along y of the plane nearest to the middle of the wall."""
    middle = recording.wall.at(0).vertices[:, 1].mean()
    return int(round((middle - recording.grid.origin[1]) / recording.grid.spacing[1]))


def forecast(model: Simulator, recording: geometry.Recording, frame: int, lead: float) -> tuple[np.ndarray, int]:
    """The forecast field (3, *shape), m/s, and the frame it is valid at."""
    later = int(np.abs(recording.time - recording.time[frame] - lead).argmin())
    start = torch.from_numpy(np.nan_to_num(recording.velocity[frame]))
    going = GridForecast(
        model, recording.grid, start, torch.from_numpy(recording.mask[frame]), float(recording.time[frame]), Transfer()
    )
    field, _ = going.at(float(recording.time[later]), torch.from_numpy(recording.mask[later]))
    return field[0].numpy(), later


def draw(
    axis: plt.Axes, recording: geometry.Recording, field: np.ndarray, mask: np.ndarray, row: int, top: float
) -> None:
    """Speed as colour and the in-plane direction as arrows."""
    grid = recording.grid
    x = 1e3 * (grid.origin[0] + grid.spacing[0] * np.arange(grid.shape[2]))
    z = 1e3 * (grid.origin[2] + grid.spacing[2] * np.arange(grid.shape[0]))
    part, seen = field[:, :, row, :], mask[:, row, :]
    speed = np.where(seen, np.linalg.norm(part, axis=0), np.nan)
    axis.pcolormesh(x, z, speed, cmap="viridis", vmin=0, vmax=top, shading="nearest")
    step = slice(None, None, 2)
    u, w = (np.where(seen, part[k], np.nan)[step, step] for k in (0, 2))
    axis.quiver(x[step], z[step], u, w, color="white", scale=12 * top, width=0.006)
    axis.set_aspect("equal")
    axis.set_xticks([])
    axis.set_yticks([])


def main() -> None:
    """Forecast from the three frames and draw them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path, metavar="RECORDING.h5", help="velocities without noise")
    parser.add_argument("--lead", type=float, default=0.02, help="s")
    parser.add_argument("--spacing", type=float, default=1e-3, help="of the particles, m")
    parser.add_argument("--out", type=Path, default=Path("forecast.png"))
    options = parser.parse_args()
    recording = geometry.read_recording(options.recording)
    model = Simulator(Scene.from_recording(recording, options.spacing), preset("default"))
    chosen, row = phases(recording, options.lead), plane_rows(recording)
    figure, axes = plt.subplots(4, len(chosen), figsize=(2.6 * len(chosen), 13), squeeze=False, layout="constrained")
    for column, (name, frame) in enumerate(sorted(chosen.items(), key=lambda item: item[1])):
        field, later = forecast(model, recording, frame, options.lead)
        before, truth = (np.nan_to_num(recording.velocity[k]) for k in (frame, later))
        both = recording.mask[frame] & recording.mask[later]
        scale = np.linalg.norm(truth[:, both])
        errors = [np.linalg.norm((one - truth)[:, both]) / scale for one in (field, before)]
        print(f"{name}: from {recording.time[frame]:.3f} s, error {errors[0]:.3f}, persistence {errors[1]:.3f}")
        top = float(np.linalg.norm(truth[:, :, row], axis=0).max())
        mask = recording.mask[later]
        rows = {
            f"{name}\nstart, {1e3 * recording.time[frame]:.0f} ms": before,
            f"forecast: {errors[0]:.2f} ({errors[1]:.2f})": field,
            f"truth, to {top:.2f} m/s": truth,
            "forecast - truth": field - truth,
        }
        for axis, (title, one) in zip(axes[:, column], rows.items(), strict=True):
            draw(axis, recording, one, recording.mask[frame] if one is before else mask, row, top)
            axis.set_title(title, fontsize=9)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
