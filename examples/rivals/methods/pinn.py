"""A physics-informed network: velocity and pressure, mass, momentum and walls as losses, on windows of a few frames.

The idea of the physics-informed vector flow mappings (Ling et al. 2024; AI-VFM 2025). Momentum is that of an inviscid
fluid: at the Reynolds numbers of a ventricle the viscous term is a thousandth of the others.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

import geometry

from .sine import Samples, SineField, batch, fitted, leak, misfit


def velocity(value: Tensor, _: Tensor) -> Tensor:
    """The first three outputs (n, 3)."""
    return value[:, :3]


def residuals(value: Tensor, slope: Tensor, data: Samples) -> tuple[Tensor, Tensor]:
    """Mean squares of div v and of dv/dt + (v . grad) v + grad p, in units of the window's speed and length."""
    flow, gradient = value[:, :3], slope[:, :3, :3]  # gradient[n, j, i] = d v_i / d x_j
    divergence = gradient.diagonal(dim1=1, dim2=2).sum(1)
    strouhal = data.length / (data.duration * data.speed)
    carried = (flow[:, :, None] * gradient).sum(1)
    momentum = strouhal * slope[:, 3, :3] + carried + slope[:, :3, 3]
    return divergence.square().mean(), momentum.square().mean()


def fit(
    recording: geometry.Recording,
    *,
    frequency: float = 3.0,
    steps: int = 400,
    mass: float = 0.01,
    momentum: float = 0.001,
    wall: float = 1.0,
    power: float = 1.0,
    size: int = 1024,
) -> np.ndarray:
    """Train on random batches of ``size`` samples, at which mass and momentum are asked for as well."""

    def loss(network: SineField, data: Samples, generator: torch.Generator) -> Tensor:
        index = batch(data, size, generator)
        on_wall = torch.randint(len(data.wall), (size // 4,), generator=generator)
        value, slope = network(data.places[index])
        spread, force = residuals(value, slope, data)
        total = misfit(velocity(value, slope), data, index) + mass * spread + momentum * force
        return total + wall * leak(network, velocity, data, on_wall)

    return fitted(recording, 4, loss, velocity, frequency=frequency, steps=steps, power=power)
