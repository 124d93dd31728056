"""The phantom in the plane through both valves and in the one across it, every 25 ms (Grønli 2017, figs. 4.1, 4.2)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from torchsph.evaluation.metrics import evaluate

from ..material import Material
from ..record import Claim, Result
from ..style import planes, sequence

INTERVAL = 0.025  # s


def make(material: Material) -> Result:
    """Speeds, and how well the flow through the orifices is that of the moving walls."""
    truth = material.truth
    frames = material.frames_every(2 * INTERVAL, 9)
    speed = np.linalg.norm(np.where(truth.mask[:, None], truth.velocity, 0.0), axis=1).reshape(truth.frames, -1)
    balance = evaluate(truth.select(np.array(frames)))["flow_rate_error"].value
    top = float(speed.max())
    numbers = {
        "peak_speed": top,
        "peak_time": float(truth.time[speed.max(1).argmax()]),
        "rms_speed": float(np.sqrt((speed**2).sum() / np.asarray(truth.mask, bool).sum())),
        "volume": [float(v) for v in np.asarray(truth.volume)[frames]] if truth.volume is not None else [],
        "flow_rate_error": balance,
        "times": [float(truth.time[k]) for k in frames],
    }
    claim = Claim(
        "the phantom is accurate enough to be the ground truth of the flow inside its walls",
        balance is not None and balance < 0.1,
        f"the flow read off the field at the orifices differs from dV/dt of the walls by {balance:.3f} of its RMS",
    )

    def draw() -> Figure:
        first, second = planes(truth)
        rows = {"through both valves": (truth.velocity, first), "across": (truth.velocity, second)}
        return sequence(truth, rows, frames, 0.8 * top)

    return Result(numbers, [claim], material.settings(interval_s=2 * INTERVAL), draw)
