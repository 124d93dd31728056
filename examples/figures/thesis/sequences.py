"""The processed measurement over the beat, by particles and by splines (Grønli 2017, figs. 4.16 and 4.17)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import laplace

from torchsph.evaluation.metrics import filled_velocity

from ..material import Material
from ..record import Claim, Result
from ..style import planes, sequence
from .noise import METHODS

INTERVAL = 0.05  # s


def make(material: Material) -> Result:
    """How much of the true field's curvature each sequence has: below 1 it looks softer than the truth."""
    fields = {method: np.asarray(material.analysis(method).velocity) for method in METHODS}
    lived = slice(0, min(map(len, fields.values())))  # frames that all of them have
    fields = {method: field[lived] for method, field in fields.items()}
    truth, measured = material.true_frames.select(lived), material.measured.select(lived)
    mask = np.asarray(truth.mask, bool)
    true = np.where(mask[:, None], np.nan_to_num(truth.velocity), 0.0)
    deep = np.stack([(laplace(one.astype(float), mode="constant") == 0) & one for one in mask])
    texture = {name: _curvature(field, deep) / _curvature(true, deep) for name, field in fields.items()}
    numbers = {"texture": texture, "times": truth.time.tolist()}
    claim = Claim(
        "spline results have a softer expression than those of the SPH model",
        texture["spline, thesis"] < texture["sph, thesis"],
        "of the true field's curvature: " + ", ".join(f"{name} {value:.2f}" for name, value in texture.items()),
    )

    def draw() -> Figure:
        step = max(int(round(INTERVAL / float(np.diff(truth.time).mean()))), 1)
        frames = [0, truth.frames - 1] if material.fast else list(range(1, truth.frames, step))
        plane = planes(truth)[0]
        rows = {"truth": (true, plane), "measured": (filled_velocity(measured), plane)}
        rows |= {name: (field, plane) for name, field in fields.items()}
        return sequence(truth, rows, frames, 0.8 * float(np.linalg.norm(true, axis=1).max()))

    return Result(numbers, [claim], material.settings(), draw)


def _curvature(field: np.ndarray, deep: np.ndarray) -> float:
    """RMS Laplacian over nodes whose neighbours lie in the mask."""
    parts = [laplace(component)[where] ** 2 for frame, where in zip(field, deep, strict=True) for component in frame]
    return float(np.sqrt(np.concatenate(parts).mean()))
