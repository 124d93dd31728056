"""The measures of the table: of the velocities, and of what people read out of them."""

from __future__ import annotations

import numpy as np

import geometry
from torchsph.evaluation.metrics import evaluate
from torchsph.haemodynamics import FlowDomain, flow_quantities

READ_OUT = ("energy_loss", "pressure_difference")


def read_out(recording: geometry.Recording, domain: FlowDomain) -> dict[str, np.ndarray]:
    """Energy loss and pressure difference from base to apex over time, (T,) each."""
    found = flow_quantities(domain, np.nan_to_num(recording.velocity))
    return {name: np.asarray(found[name], np.float64) for name in READ_OUT}


def scores(
    velocity: np.ndarray, measured: geometry.Recording, truth: geometry.Recording, true_curves: dict[str, np.ndarray]
) -> dict[str, float]:
    """Every measure of a method's velocities (T, 3, *shape), m/s.

    ``energy_loss`` is the mean over that of the truth, ``pressure_difference`` the RMS error over the RMS of the truth.
    """
    found = measured.with_velocity(velocity)
    values = evaluate(found, truth)
    row = {name: values[name].value for name in ("nrmse", "direction_error_deg", "divergence_rms", "wall_normal_rms")}
    curves = read_out(found, FlowDomain.from_recording(truth))
    known = np.isfinite(curves["pressure_difference"]) & np.isfinite(true_curves["pressure_difference"])
    wrong = (curves["pressure_difference"] - true_curves["pressure_difference"])[known]
    row["energy_loss"] = float(np.nanmean(curves["energy_loss"]) / np.nanmean(true_curves["energy_loss"]))
    scale = float(np.sqrt((true_curves["pressure_difference"][known] ** 2).mean()))
    row["pressure_difference"] = float(np.sqrt((wrong**2).mean()) / scale)
    return {name: None if value is None else float(value) for name, value in row.items()}
