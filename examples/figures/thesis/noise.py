"""How far splines, one SPH simulation and the ensemble suppress noise over the beat (Grønli 2017, fig. 4.14)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from torchsph.evaluation.metrics import filled_velocity

from ..material import Material, per_frame_error
from ..record import Claim, Result
from ..style import COLOUR, axes

METHODS = ("spline, thesis", "sph, thesis", "spline, default", "ensemble, default")


def make(material: Material) -> Result:
    """RMS error of every frame by method, and of the measurement itself."""
    fields = {"raw": filled_velocity(material.measured)}
    fields |= {method: material.analysis(method).velocity for method in METHODS}
    frames = min(map(len, fields.values()))  # that all of them have
    fields = {name: field[:frames] for name, field in fields.items()}
    truth = material.true_frames.select(slice(0, frames))
    mask, true = np.asarray(truth.mask, bool), np.nan_to_num(truth.velocity)
    errors = {name: per_frame_error(field, true, mask) for name, field in fields.items()}
    numbers = {
        "time": truth.time.tolist(),
        "rms_speed": errors["raw"][1].tolist(),
        "rms_error": {name: wrong.tolist() for name, (wrong, _) in errors.items()},
        "nrmse": {name: float(np.sqrt((wrong**2).sum() / (right**2).sum())) for name, (wrong, right) in errors.items()},
    }
    found = numbers["nrmse"]
    listed = ", ".join(f"{name} {value:.3f}" for name, value in found.items())
    claims = [
        Claim(
            "both the SPH model and the B-spline reduce the noise of the estimates",
            found["spline, thesis"] < found["raw"] and found["sph, thesis"] < found["raw"],
            f"NRMSE: {listed}",
        ),
        Claim(
            "the two models appear to provide approximately the same accuracy",
            0.8 < found["sph, thesis"] / found["spline, thesis"] < 1.25,
            f"error of the SPH model over that of the spline {found['sph, thesis'] / found['spline, thesis']:.2f} with "
            f"the thesis's settings; ensemble over spline {found['ensemble, default'] / found['spline, default']:.2f} "
            "with the defaults",
        ),
    ]

    def draw() -> Figure:
        figure, panels = axes(1, 1, 9, 4)
        panel = panels[0, 0]
        for name, row in numbers["rms_error"].items():
            style = ":" if name == "raw" else "-"
            panel.plot(1e3 * truth.time, row, style, color=COLOUR[name], label=f"{name}: {found[name]:.3f}")
        panel.fill_between(1e3 * truth.time, numbers["rms_speed"], color="0.92", label="RMS speed of the truth")
        panel.set(xlabel="ms", ylabel="RMS error, m/s", ylim=(0, None))
        panel.legend(fontsize=8, title="NRMSE over all frames", loc="center left", bbox_to_anchor=(1.0, 0.5))
        return figure

    return Result(numbers, claims, material.settings(), draw)
