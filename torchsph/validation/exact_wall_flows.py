"""Flows with known solutions between curved walls, for tests and benchmarks: pipe, oscillating pipe, cylinders."""

from __future__ import annotations

import numpy as np
import torch
from scipy.special import j0, j1, jn_zeros, jv
from torch import Tensor

from .options import WeaklyCompressibleOptions

# of the series of a pipe flow started from rest
_PIPE_TERMS = 60


def pipe_flow(radius: Tensor, viscosity: float, force: float, wall: float) -> Tensor:
    """Steady axial velocity (n,), m/s, in a round pipe (Hagen-Poiseuille): force / (4 nu) (R^2 - r^2).

    Args:
        radius: (n,), distance from the axis, m.
        viscosity: kinematic, m^2/s.
        force: acceleration, m/s^2.
        wall: radius R of the pipe, m.
    """
    return force / (4 * viscosity) * (wall**2 - radius**2)


def pipe_start(radius: Tensor, time: float, viscosity: float, force: float, wall: float) -> Tensor:
    """Velocity (n,), m/s, of the pipe flow started from rest (Szymanski 1932; Batchelor 1967, eq. 4.3.19).

    Arguments as for ``pipe_flow``.
    """
    zeros = jn_zeros(0, _PIPE_TERMS)
    weight = 2 * force * wall**2 / viscosity / (zeros**3 * j1(zeros))
    modes = j0(np.outer(radius.double().numpy() / wall, zeros))
    gone = modes @ (weight * np.exp(-(zeros**2) * viscosity * time / wall**2))
    return pipe_flow(radius, viscosity, force, wall) - torch.from_numpy(gone).to(radius.dtype)


def womersley(radius: Tensor, time: float, viscosity: float, force: float, frequency: float, wall: float) -> Tensor:
    """Axial velocity (n,), m/s, in a pipe driven by force cos(2 pi f t) (Womersley 1955, eq. 8).

    Args:
        radius: (n,), distance from the axis, m.
        time: s.
        viscosity: kinematic, m^2/s.
        force: amplitude of the acceleration, m/s^2.
        frequency: f, 1/s.
        wall: radius R of the pipe, m.
    """
    rate = 2 * np.pi * frequency
    number = 1j**1.5 * wall * np.sqrt(rate / viscosity)
    shape = 1 - jv(0, number * radius.double().numpy() / wall) / jv(0, number)
    return torch.from_numpy((force / (1j * rate) * shape * np.exp(1j * rate * time)).real).to(radius.dtype)


def cylinder_couette(radius: Tensor, inner: tuple[float, float], outer: tuple[float, float]) -> Tensor:
    """Steady tangential velocity (n,), m/s, between rotating cylinders: A r + B / r (Taylor 1923).

    Args:
        radius: (n,), distance from the axis, m.
        inner: radius, m, and wall speed, m/s, of the inner cylinder.
        outer: likewise of the outer cylinder.
    """
    (a, speed_a), (b, speed_b) = inner, outer
    rigid = (speed_b * b - speed_a * a) / (b**2 - a**2)
    swirl = (speed_a / a - speed_b / b) * a**2 * b**2 / (b**2 - a**2)
    return rigid * radius + swirl / radius


# Shear between curved walls: even particles matter as much as the wall does. With that preset's shifting the Couette
# flow between cylinders is 2.5 % off at 16 across, with this one 0.2 % (tests/torchsph/validation/test_cylinders.py).
CURVED_WALL_OPTIONS: WeaklyCompressibleOptions = {
    "sound_speed": 10.0,
    "artificial_viscosity": None,
    "shifting": 8.0,
    "shifting_speed": "largest",
}
