"""One frame imposed on particles and fetched, and through splines, over their number (Grønli 2017, figs. 4.9, 4.10)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import laplace

from ..material import Material, per_frame_error
from ..record import Claim, Result
from ..style import PANEL, axes, flow, planes
from .smoothing import COARSE, NODES, SPACINGS, particle_errors, spline_fields


def make(material: Material) -> Result:
    """Errors of the panels, and what is left of the true field's curvature in each (texture)."""
    truth = material.truth
    frame = truth.frames - 1 if material.fast else 0
    time = truth.time[frame : frame + 1]
    spacings, nodes = (COARSE, NODES[1:4:2]) if material.fast else (SPACINGS[0:5:2], NODES[0:5:2])
    mask = np.asarray(truth.mask[frame], bool)
    true = np.nan_to_num(truth.velocity[frame])
    rows: dict[str, list[tuple[str, np.ndarray]]] = {"thesis": [], "default": [], "spline": []}
    for spacing in spacings:
        for name in ("thesis", "default"):
            fetched, _, _, count = particle_errors(material, time, spacing, name)
            rows[name].append((f"{count} particles", fetched[0]))
    for one in nodes:
        field = spline_fields(material, time, one, {})[0]
        rows["spline"].append((f"{'x'.join(map(str, one))} coefficients", field.astype(np.float32)))
    numbers: dict[str, object] = {"time": float(time[0])}
    for name, found in rows.items():
        numbers[name] = [
            {"size": title, "nrmse": _error(field, true, mask), "texture": _texture(field, true, mask)}
            for title, field in found
        ]
    fine = {name: numbers[name][-1] for name in rows}  # type: ignore[index]
    claims = [
        Claim(
            "more particles, or more coefficients, resolve the field better",
            all(numbers[name][0]["nrmse"] > numbers[name][-1]["nrmse"] for name in rows),  # type: ignore[index]
            ", ".join(f"{name}: {numbers[name][0]['nrmse']:.3f} to {fine[name]['nrmse']:.3f}" for name in rows),  # type: ignore[index]
        ),
        Claim(
            "particles leave more texture, splines look as if blurred",
            bool(fine["default"]["texture"] > fine["spline"]["texture"]),
            f"of the true field's curvature are left: particles {fine['thesis']['texture']:.2f} (thesis) and "
            f"{fine['default']['texture']:.2f} (default), spline {fine['spline']['texture']:.2f}",
        ),
    ]

    def draw() -> Figure:
        plane, top = planes(truth)[0], 0.9 * float(np.linalg.norm(true, axis=0).max())
        figure, panels = axes(3, len(spacings) + 1, PANEL * (len(spacings) + 1), 1.65 * PANEL)
        for line, (name, found) in zip(panels, rows.items(), strict=True):
            for axis, (title, field) in zip(line, [("true", true), *found], strict=True):
                flow(axis, truth, field, frame, plane, top)
                axis.set_title(title, fontsize=8)
            line[0].set_ylabel(name)
        return figure

    return Result(numbers, claims, material.settings(spacings_m=list(spacings)), draw)


def _error(field: np.ndarray, true: np.ndarray, mask: np.ndarray) -> float:
    wrong, right = per_frame_error(field[None], true[None], mask[None])
    return float(wrong[0] / right[0])


def _texture(field: np.ndarray, true: np.ndarray, mask: np.ndarray) -> float:
    """RMS of the Laplacian over that of the true field, at nodes whose neighbours lie in the mask."""
    deep = laplace(mask.astype(float), mode="constant") == 0
    deep &= mask
    size = [np.sqrt(np.mean([laplace(part)[deep] ** 2 for part in each])) for each in (field, true)]
    return float(size[0] / size[1])
