"""A velocity field as the curl of a sine network, free of divergence by construction, closed at the walls.

The idea of DAF-FlowNet (arXiv 2604.00205) and of the neural fields of Saitta et al. (2024), on windows of frames.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

import geometry

from .sine import Samples, SineField, batch, fitted, leak, misfit


def curl(_: Tensor, slope: Tensor) -> Tensor:
    """(n, 3) from derivatives (n, 4, 3) of a vector potential."""
    by_x, by_y, by_z = slope[:, 0], slope[:, 1], slope[:, 2]
    return torch.stack([by_y[:, 2] - by_z[:, 1], by_z[:, 0] - by_x[:, 2], by_x[:, 1] - by_y[:, 0]], 1)


def fit(
    recording: geometry.Recording,
    *,
    frequency: float = 3.0,
    steps: int = 400,
    wall: float = 1.0,
    power: float = 1.0,
    size: int = 1024,
) -> np.ndarray:
    """Train on random batches of ``size`` samples; ``wall`` weighs what goes through the walls."""

    def loss(network: SineField, data: Samples, generator: torch.Generator) -> Tensor:
        index = batch(data, size, generator)
        on_wall = torch.randint(len(data.wall), (size // 4,), generator=generator)
        return misfit(curl(*network(data.places[index])), data, index) + wall * leak(network, curl, data, on_wall)

    return fitted(recording, 3, loss, curl, frequency=frequency, steps=steps, power=power)
