"""What walls and valves alone make of a beat: one simulation that never sees a measurement after its first frame."""

from __future__ import annotations

import numpy as np
import torch
from tqdm import tqdm

import geometry
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulator import Simulator


def run_freely(
    measured: geometry.Recording, model: Simulator, start: np.ndarray, *, seed: int = 0, progress: bool = False
) -> geometry.Recording:
    """Simulate the recording's beat from the velocity ``start`` (D, *shape), m/s, at its first frame.

    The baseline of every assimilation: what of the flow follows from the walls' motion. Returns the fetched grids at
    the recording's times.
    """
    time, grid = measured.time, measured.grid
    masks = [torch.from_numpy(np.array(mask, bool)).to(model.device) for mask in measured.mask]
    velocity = torch.from_numpy(np.asarray(start, np.float32)).to(model.device)
    going = GridForecast(model, grid, velocity, masks[0], float(time[0]), Transfer(fade=None), seed=seed)
    fields, missing = [], []
    for frame in tqdm(range(measured.frames), desc="free", unit="frame", disable=None if progress else True):
        value, covered = going.at(float(time[frame]), masks[frame])
        fields.append(value[0].cpu().numpy())
        missing.append(int((masks[frame] & ~covered[0]).sum()))
    return measured.with_velocity(
        np.stack(fields), uncovered=np.array(missing, np.int64), description="one SPH simulation without data"
    )
