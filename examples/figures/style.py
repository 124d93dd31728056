"""How the pictures look: sizes, colours, planes of a flow, small files."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

import geometry
from torchsph.evaluation.slices import Plane, cut, valve_plane

DPI = 80
MOST_BYTES = 150_000  # of a picture
WIDTH = 10.0  # inches, of a picture
PANEL = 1.9  # inches, of one frame in a plane
COLOURS = 128  # of a picture's palette: keeps its file small
SPEEDS = "magma"
COLOUR = {
    "truth": "0.2",
    "measured": "0.6",
    "raw": "0.6",
    "persistence": "0.6",
    "thesis": "tab:orange",
    "default": "tab:blue",
    "spline, thesis": "tab:red",
    "sph, thesis": "tab:orange",
    "spline, default": "tab:purple",
    "ensemble, default": "tab:blue",
}


def axes(rows: int, columns: int, width: float = WIDTH, height: float = 3.2) -> tuple[Figure, np.ndarray]:
    """A figure and its axes (rows, columns); ``height`` inches a row."""
    return plt.subplots(rows, columns, figsize=(width, height * rows), squeeze=False, layout="constrained")


def planes(recording: geometry.Recording) -> tuple[Plane, Plane]:
    """The plane through both valves and the apex, and the one across it between the valves."""
    first = valve_plane(recording)
    normal = np.cross(first.across, first.along)
    points = recording.wall_for("a picture").vertices.reshape(-1, 3)
    middle = points.mean(0)
    origin = middle + ((first.origin - middle) @ first.along) * first.along + 1e-7 * first.across
    s, t = (points - origin) @ normal, (points - origin) @ first.along
    margin = 0.02 * np.ptp(t)
    return first, Plane(origin, normal, first.along, (s.min() - margin, s.max() + margin, t.min() - margin, t.max()))


def flow(
    axis: Axes, recording: geometry.Recording, velocity: np.ndarray, frame: int, plane: Plane, top: float
) -> matplotlib.collections.QuadMesh:
    """Speed as colour (to ``top``, m/s) and in-plane arrows of ``velocity`` (3, *shape), m/s, of one frame."""
    pixel = 0.5 * float(min(recording.grid.spacing))
    found = cut(recording, velocity, frame, plane, pixel)
    across, along = 1e3 * found.across, 1e3 * found.along
    mesh = axis.pcolormesh(
        across, along, found.speed, cmap=SPEEDS, vmin=0, vmax=top, shading="nearest", rasterized=True
    )
    few = slice(2, None, 4)
    size = np.maximum(found.speed[few, few], 0.15 * top)
    axis.quiver(
        across[few], along[few], *(part[few, few] / size for part in found.velocity), color="w", scale=16, width=0.008
    )
    axis.add_collection(LineCollection(1e3 * found.outline, colors="0.4", linewidths=0.6))
    axis.set(aspect="equal", xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set_visible(False)
    return mesh


def sequence(
    recording: geometry.Recording,
    rows: dict[str, tuple[np.ndarray, Plane]],
    frames: Sequence[int],
    top: float,
) -> Figure:
    """Rows of velocities (T, 3, *shape), each in its plane, a column for each frame."""
    left, right, low, high = next(iter(rows.values()))[1].extent
    figure, panels = axes(len(rows), len(frames), PANEL * len(frames) + 1, 0.95 * PANEL * (high - low) / (right - left))
    for line, (name, (velocity, plane)) in zip(panels, rows.items(), strict=True):
        for axis, frame in zip(line, frames, strict=True):
            mesh = flow(axis, recording, velocity[frame], frame, plane, top)
        line[0].set_ylabel(name, fontsize=9)
    for axis, frame in zip(panels[0], frames, strict=True):
        axis.set_title(f"{1e3 * recording.time[frame]:.0f} ms", fontsize=9)
    figure.colorbar(mesh, ax=panels, label="m/s", fraction=0.05, pad=0.01, shrink=min(1.0, 2 / len(rows)), aspect=30)
    return figure


def save(figure: Figure, file: Path) -> None:
    """Write a picture as PNG with a palette, whole or not at all; a large one with fewer dots per inch."""
    part, dpi = file.with_suffix(".part"), float(DPI)
    while True:
        buffer = io.BytesIO()
        figure.savefig(buffer, dpi=dpi, format="png")
        image = Image.open(buffer).convert("RGB").quantize(COLOURS, kmeans=1, dither=Image.Dither.NONE)
        image.save(part, format="PNG", optimize=True)
        if part.stat().st_size < MOST_BYTES or dpi < 0.5 * DPI:
            break
        dpi *= 0.85
    plt.close(figure)
    part.replace(file)
