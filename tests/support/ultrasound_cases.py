"""Scenes shared by the tests of the echo chain; small, so that a packet takes a fraction of a second."""

import numpy as np
import torch

import geometry
from geometry import Grid
from torchsph.ultrasound.scanner.echoes import EchoModel, simulate_packet
from torchsph.ultrasound.scanner.flow import LinearFlow

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


def box_wall(low, high):
    """Closed box around the blood, triangles facing outwards."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    faces = np.array(
        [
            [0, 2, 3],
            [0, 3, 1],
            [4, 5, 7],
            [4, 7, 6],
            [0, 1, 5],
            [0, 5, 4],
            [2, 6, 7],
            [2, 7, 3],
            [0, 4, 6],
            [0, 6, 2],
            [1, 3, 7],
            [1, 7, 5],
        ],
        np.int32,
    )
    vertices = np.asarray(low) + corners * (np.asarray(high) - np.asarray(low))
    return geometry.Wall(vertices=vertices, faces=faces, region=np.zeros(len(faces), np.uint8), velocity=None)


def recording(field, frames=4, shape=(24, 18, 20)):
    """A 3-D recording of field(x, y, z) -> (3, ...) m/s, metres from the middle of a 1 mm grid."""
    spacing = np.full(3, 1e-3)
    origin = -0.5 * spacing * (np.array(shape[::-1]) - 1)
    grid = geometry.Grid(origin=origin, spacing=spacing, shape=shape)
    z, y, x = np.meshgrid(*(origin[2 - a] + spacing[2 - a] * np.arange(shape[a]) for a in range(3)), indexing="ij")
    velocity = np.repeat(np.stack(field(x, y, z)).astype(np.float32)[None], frames, 0)
    mask = np.zeros((frames, *shape), bool)
    mask[:, 1:-1, 1:-1, 1:-1] = True
    return geometry.Recording(
        time=5e-3 * np.arange(frames),
        grid=grid,
        velocity=velocity * mask[:, None],
        mask=mask,
        wall=box_wall(origin, -origin),
        rho=1060.0,
        mu=4e-3,
    )


def vortex(x, y, z):
    """A ring-like swirl with some axial flow; speeds to 0.5 m/s, still regions and shear."""
    reach = np.exp(-(x**2 + y**2 + z**2) / (2 * 5e-3**2))
    return -80 * y * reach, 80 * z * reach, 60 * x * reach + 0.2 * reach


def uniform(x, y, z):
    return np.full_like(x, 0.3), np.full_like(x, -0.2), np.full_like(x, 0.25)
