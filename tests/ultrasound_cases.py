"""Scenes shared by the tests of the echo chain; small, so that a packet takes a fraction of a second."""

import torch

from geometry import Grid
from torchsph.ultrasound.echoes import EchoModel, simulate_packet
from torchsph.ultrasound.flow import LinearFlow

STEP = 1e-3 / 6


def cube(half=18, centre=(0.0, 0.0, 24e-3)):
    """Image grid of 2 half + 1 nodes per axis around ``centre`` (x, y, z or x, y)."""
    return Grid(tuple(c - half * STEP for c in centre), (STEP,) * len(centre), (2 * half + 1,) * len(centre))


def lattice(centre=(0.0, 0.0, 24e-3), half=2, step=1e-3):
    """Points to track: (2 half + 1)^D around ``centre``."""
    axis = torch.arange(-half, half + 1, dtype=torch.float64) * step
    return torch.cartesian_prod(*[axis] * len(centre)) + torch.tensor(centre, dtype=torch.float64)


def packet(velocity, seed=0, *, grid=None, gradient=None, dtype=torch.float32, **model):
    """Echoes of uniform or sheared motion without tissue."""
    grid = grid or cube()
    centre = tuple(0.5 * (a + b) for a, b in zip(grid.origin, grid.upper, strict=True))
    flow = LinearFlow(tuple(velocity), gradient, centre)
    return simulate_packet(flow, grid, EchoModel(**model), 0.0, torch.Generator().manual_seed(seed), dtype=dtype)
