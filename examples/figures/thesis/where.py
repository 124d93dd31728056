"""Where the error of the processed measurement sits, 50 ms into the beat (Grønli 2017, fig. 4.15)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ..material import Material
from ..record import Claim, Result
from ..style import PANEL, axes, flow, planes
from .noise import METHODS

TIME = 0.05  # s
NEAR = 8e-3  # m, of the outlet's middle


def make(material: Material) -> Result:
    """Part of the squared error near the outlet, beside the part of the nodes that lie there."""
    truth = material.true_frames
    frame = int(np.abs(truth.time - TIME).argmin())
    mask = np.asarray(truth.mask[frame], bool)
    true = np.where(mask, np.nan_to_num(truth.velocity[frame]), 0.0)
    surface = truth.wall_for("the outlet").at(frame)
    outlet = surface.centroids[surface.region == 2].mean(0)
    away = np.linalg.norm(truth.grid.nodes().numpy() - outlet, axis=1).reshape(truth.grid.shape)
    near = mask & (away < NEAR)
    errors = {name: np.where(mask, material.analysis(name).velocity[frame] - true, 0.0) for name in METHODS}
    square = {name: (error**2).sum(0) for name, error in errors.items()}
    numbers = {
        "time": float(truth.time[frame]),
        "nodes_near_outlet": float(near.sum() / mask.sum()),
        "squared_flow_near_outlet": float((true**2).sum(0)[near].sum() / (true**2).sum()),
        "squared_error_near_outlet": {name: float(one[near].sum() / one.sum()) for name, one in square.items()},
        "rms_error": {name: float(np.sqrt(one[mask].mean())) for name, one in square.items()},
    }
    parts = numbers["squared_error_near_outlet"]
    claim = Claim(
        "most of the SPH model's error is located near the outlet",
        parts["sph, thesis"] > 0.5,
        f"{100 * parts['sph, thesis']:.0f} % of the squared error lies within {1e3 * NEAR:.0f} mm of the outlet, where "
        f"{100 * numbers['nodes_near_outlet']:.0f} % of the nodes are (t = {1e3 * numbers['time']:.0f} ms); with the "
        f"ensemble {100 * parts['ensemble, default']:.0f} %",
    )

    def draw() -> Figure:
        plane, top = planes(truth)[0], 0.8 * float(np.linalg.norm(true, axis=0).max())
        figure, panels = axes(1, 1 + len(errors), PANEL * (1 + len(errors)), 1.8 * PANEL)
        for axis, (name, field) in zip(panels[0], {"truth": true, **errors}.items(), strict=True):
            mesh = flow(axis, truth, field, frame, plane, top)
            axis.set_title(name if name == "truth" else f"error of\n{name}", fontsize=8)
        figure.colorbar(mesh, ax=panels, label="m/s", fraction=0.03)
        return figure

    return Result(numbers, [claim], material.settings(near_m=NEAR), draw)
