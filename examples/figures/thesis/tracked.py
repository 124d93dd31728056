"""Velocities that a speckle tracker finds in simulated echoes, in two planes (Grønli 2017, figs. 4.4 and 4.5)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from torchsph.evaluation.metrics import filled_velocity
from torchsph.ultrasound import SpeckleOptions, measure_speckle

from ..material import Material, coarser
from ..record import Claim, Result
from ..style import planes, sequence


def make(material: Material) -> Result:
    """Track a few frames of the truth; errors where estimates were accepted, and how far they are to be trusted."""
    truth = material.truth
    frames = [truth.frames // 2] if material.fast else material.frames_every(0.075, 6)
    part = truth.select(np.array(frames))
    if material.fast:
        part = coarser(part, 3)
    options = SpeckleOptions(every=1, training=4 if material.fast else 24)
    found = measure_speckle(part, options, material.seed)
    mask, true = np.asarray(part.mask, bool), np.asarray(part.velocity)
    kept = mask & (np.asarray(found.weight) > 0)
    error = np.where(mask[:, None], np.nan_to_num(found.velocity) - np.nan_to_num(true), 0.0)
    across, along = (np.sqrt((error[:, axes] ** 2).mean(1)[kept].mean()) for axes in ([0, 1], [2]))
    half = np.median(np.asarray(found.weight)[kept])
    sure, unsure = (
        np.sqrt((error**2).sum(1)[kept & side].mean())
        for side in (np.asarray(found.weight) >= half, np.asarray(found.weight) < half)
    )
    numbers = {
        "accepted": float(kept.sum() / mask.sum()),
        "rms_error_lateral": float(across),
        "rms_error_axial": float(along),
        "rms_error_of_the_surer_half": float(sure),
        "rms_error_of_the_other_half": float(unsure),
        "rms_speed": float(np.sqrt((true**2).sum(1)[mask].mean())),
        "times": [float(t) for t in part.time],
    }
    claims = [
        Claim(
            "estimates are noisy, and need a regulariser before anything is read out of them",
            bool(across > 0.5 * numbers["rms_speed"] or numbers["accepted"] < 0.9),
            f"RMS error of accepted estimates {across:.3f} m/s across and {along:.3f} along the beam beside an RMS "
            f"speed of {numbers['rms_speed']:.3f}; {100 * numbers['accepted']:.0f} % of the nodes accepted",
        ),
        Claim(
            "the speckle correlation can serve as the weight of each estimate",
            bool(sure < unsure),
            f"RMS error {sure:.3f} m/s in the surer half, {unsure:.3f} in the other",
        ),
    ]

    def draw() -> Figure:
        top = 0.8 * float(np.linalg.norm(true, axis=1).max())
        shown = filled_velocity(found)
        first, second = planes(part)
        rows = {"true": (true, first), "tracked": (shown, first), "tracked, across": (shown, second)}
        return sequence(part, rows, range(part.frames), top)

    return Result(numbers, claims, material.settings(options=repr(options)), draw)
