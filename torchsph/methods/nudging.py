"""Nudging: one simulator runs along, each measured frame is imposed on it, the grid is fetched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

import geometry
from geometry.arguments import checked
from torchsph.simulator.simulator import Simulation, Simulator
from torchsph.simulator.transfer.checks import check_grid

from .measurement.error_model import ObservationError
from .measurement.frame_splines import node_weights
from .measurement.prepared import PreparedMeasurement

# share of the innovation's variance that the forecast keeps for itself at least: it is never believed blindly
_LEAST_FORECAST_SHARE = 0.05


@dataclass(frozen=True)
class FilteredRun:
    """What the filter made of a recording: the analyses and the accounts of the simulator."""

    recording: geometry.Recording
    info: dict[str, object]


@checked
def filter_sph(
    measured: geometry.Recording | PreparedMeasurement,
    model: Simulator,
    *,
    seed: int = 0,
    progress: bool = False,
) -> FilteredRun:
    """Run one simulator through a recording and impose each frame on the running particles (Grønli 2017, sec. 3.1.6).

    A particle's velocity v becomes  v + K (u - v)  with the measured u at its place (moving least squares over the
    nodes, weighted by their confidence) and  K = P / (P + R):  R the measurement's error variance there, P the
    forecast's, estimated at every frame from the innovations (their variance exceeds R by P).

    Args:
        measured: the recording, prepared or not.
        model: simulator of its scene.
        seed: of everything random.
        progress: show a bar.

    Returns:
        The fetched grid after each frame's update, on the measurement's grid, mask and times.

    Raises:
        ValueError: the measurement does not hold full vectors, or is of another dimension than the model's scene.
    """
    check_grid(
        measured.grid if isinstance(measured, geometry.Recording) else measured.recording.grid, model.scene.dimension
    )
    prepared = PreparedMeasurement.of(measured, progress=progress)
    prepared.type.require_full("method sph imposes")
    measured, error = prepared.recording, prepared.error
    run = model.start(float(measured.time[0]), seed=seed)
    fields, missing = [], []
    frames = tqdm(range(measured.frames), desc="sph", unit="frame", disable=None if progress else True)
    for frame in frames:
        mask = torch.from_numpy(np.array(measured.mask[frame], bool)).to(model.device)
        if frame:
            run.advance(float(measured.time[frame]))
        background = run.fetch(measured.grid, mask)
        _update(run, measured, frame, error, background.value[0] if frame else None)
        found = run.fetch(measured.grid, mask)
        fields.append(found.value[0].cpu().numpy())
        missing.append(int((mask & ~found.covered[0]).sum()))
    recording = measured.with_velocity(
        np.stack(fields),
        uncovered=np.array(missing, np.int64),
        description="one SPH simulation with every frame imposed on its particles",
    )
    return FilteredRun(recording, run.record.summary())


def _update(
    run: Simulation, measured: geometry.Recording, frame: int, error: ObservationError, background: Tensor | None
) -> None:
    """Pull the particles towards the measurement of one frame; the first frame has no forecast to weigh against."""
    weight = node_weights(measured, frame)
    used = weight > 0
    if not used.any():  # a frame without data is forecast
        return
    variance = error.variance(measured, frame).mean(0)
    observed = np.nan_to_num(measured.velocity[frame])
    gain = np.ones_like(weight)
    if background is not None:
        innovation = (observed - background.cpu().numpy())[:, used]
        total = float(np.mean(innovation**2))
        own = max(total - float(variance[used].mean()), _LEAST_FORECAST_SHARE * total)
        gain = own / (own + variance) if total > 0 else np.zeros_like(weight)
    device, dtype = run.particles.position.device, run.particles.position.dtype
    fields = torch.from_numpy(np.concatenate([observed, gain[None]])).to(device, dtype)
    run.pull(measured.grid, fields[:-1], fields[-1], torch.from_numpy(weight).to(device, dtype))
