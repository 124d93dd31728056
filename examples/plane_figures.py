"""Two pictures of planes: an apical plane as measured, smoothed and assimilated, and colour Doppler that has wrapped.

    python examples/plane_figures.py ../shared/data/lv_phantom_a.h5 [--out .] [--spacing 0.002] [--members 8]

The plane is the long axis of the recording's walls and `--right`; what is measured of it is the noise model's, at its
own noise and at twice that. Written are `planes.png` and `doppler_plane.png`, with their errors in the titles.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from scipy.ndimage import binary_erosion

import geometry
import torchsph as ts
from torchsph.haemodynamics import long_axis
from torchsph.ultrasound.measurements.noise import NoiseModel, measure_noise

HERE = Path(__file__).resolve().parent
NOISES = {
    "measured": NoiseModel(every=2),
    "twice the noise": NoiseModel(every=2, lateral=0.12, axial=0.05, outliers=0.03),
}
WRAPS = 2.1  # of the peak speed along the beam over the Nyquist limit


def main() -> None:
    """Draw both pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("true", type=Path)
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--right", type=float, nargs=3, default=(1.0, 0.0, 0.0), help="x of the plane")
    parser.add_argument("--frames", type=int, nargs=2, default=(64, 78), help="of the true recording")
    parser.add_argument("--spacing", type=float, default=0.002, help="of the particles, m")
    parser.add_argument("--members", type=int, default=8)
    options = parser.parse_args()
    true = geometry.read_recording(options.true)
    pictures(true, options)


def pictures(true: geometry.Recording, options: argparse.Namespace) -> None:
    """Both of them, of one true recording in space."""
    base, apex = long_axis(geometry.WallMotion.from_recording(true).surface(float(true.time[0])))
    place = (base.tolist(), list(options.right), (base - apex).tolist())
    piece = slice(*options.frames)
    truth = geometry.plane_cut(true.select(piece).select(slice(0, None, 2)), *place)
    figure, axes = plt.subplots(2, 4, figsize=(9.6, 8.4), layout="constrained")
    for line, (name, noise) in zip(axes, NOISES.items(), strict=True):
        measured = geometry.plane_cut(
            measure_noise(true, noise, seed=1).select(slice(piece.start // 2, piece.stop // 2)), *place
        )
        prepared = ts.PreparedMeasurement(measured)
        model = ts.make_model(prepared.recording, spacing=options.spacing, estimates=prepared.splines.estimates)
        run = ts.assimilate(prepared, model, members=options.members, seed=0)
        shown = {"truth": truth, name: measured, "splines": prepared.smoothed, "ensemble": run.recording}
        for axis, (label, one) in zip(line, shown.items(), strict=True):
            off = "" if one is truth else f"\nerror {error(one, truth):.2f}"
            image = arrows(axis, one, truth.frames - 1, f"{label}{off}")
        figure.colorbar(image, ax=line, label="speed, m/s", shrink=0.7)
    figure.savefig(options.out / "planes.png", dpi=80)
    doppler(truth, options.out / "doppler_plane.png")


def error(found: geometry.Recording, truth: geometry.Recording) -> float:
    """Over all frames, relative to the true speed."""
    inside = np.asarray(truth.mask & found.mask, bool)
    off = np.moveaxis(np.nan_to_num(found.velocity) - truth.velocity, 1, -1)[inside]
    return float(np.sqrt(np.square(off).sum() / np.square(np.moveaxis(truth.velocity, 1, -1)[inside]).sum()))


def arrows(axis: Axes, recording: geometry.Recording, frame: int, title: str) -> QuadMesh:
    """Speed in colour and the velocities of every second node; the wall around them."""
    grid, inside = recording.grid, np.asarray(recording.mask[frame], bool)
    field = np.where(inside, np.nan_to_num(recording.velocity[frame]), np.nan)
    x, y = 1e3 * grid.nodes().numpy().T.reshape(2, *grid.shape)
    image = axis.pcolormesh(x, y, np.hypot(*field), vmin=0, vmax=0.6, cmap="viridis", shading="nearest")
    every = (slice(None, None, 2),) * 2
    axis.quiver(x[every], y[every], field[0][every], field[1][every], color="w", scale=5, width=0.006)
    walls(axis, recording, frame)
    axis.set(title=title, aspect="equal", xticks=[], yticks=[])
    return image


def walls(axis: Axes, recording: geometry.Recording, frame: int) -> None:
    """The wall black, openings in red."""
    surface = recording.wall_for("a picture").at(frame)
    for (a, b), region in zip(surface.vertices[surface.faces], surface.region, strict=True):
        axis.plot(*1e3 * np.stack([a, b]).T, color="k" if region == 0 else "tab:red", linewidth=1.5)


def doppler(truth: geometry.Recording, path: Path) -> None:
    """The velocity along the long axis: as it is, wrapped at a limit that it exceeds, and with the turns taken back."""
    frame = int(np.argmax([np.abs(field[1]).max() for field in truth.velocity]))
    along, inside = truth.velocity[frame, 1].astype(np.float64), np.asarray(truth.mask[frame], bool)
    limit = float(np.abs(along).max()) / WRAPS
    noisy = along + 0.1 * limit * np.random.default_rng(0).standard_normal(along.shape)
    wrapped = (noisy + limit) % (2 * limit) - limit
    found = geometry.unwrap(wrapped, inside, limit, inside & ~binary_erosion(inside))
    wrong = inside & (np.abs(found - noisy) > limit)
    fields = {"velocity along the beam, m/s": noisy, f"wrapped at ±{limit:.2g} m/s": wrapped}
    fields[f"unwrapped: {wrong.sum()} of {inside.sum()} nodes wrong"] = found
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 4.6), layout="constrained")
    reach = float(np.abs(noisy[inside]).max())
    x, y = 1e3 * truth.grid.nodes().numpy().T.reshape(2, *truth.grid.shape)
    for axis, (title, field) in zip(axes, fields.items(), strict=True):
        shown = np.where(inside, field, np.nan)
        image = axis.pcolormesh(x, y, shown, vmin=-reach, vmax=reach, cmap="RdBu_r", shading="nearest")
        walls(axis, truth, frame)
        axis.set(title=title, aspect="equal", xticks=[], yticks=[])
    figure.colorbar(image, ax=axes, label="m/s", shrink=0.8)
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
