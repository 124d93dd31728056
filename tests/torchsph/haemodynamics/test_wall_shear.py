"""Wall shear stress against pipe flow, steady and oscillating, and where its limit lies."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from haemodynamics_cases import order

import geometry
from torchsph.haemodynamics.wall_shear import WallShear
from torchsph.validation.exact_wall_flows import pipe_flow, womersley

RADIUS, RHO = 0.01, 1060.0


def pipe(spacing):
    half = int(RADIUS / spacing) + 2
    grid = geometry.Grid((-(half - 0.37) * spacing,) * 2 + (0.0,), (spacing,) * 3, (7, 2 * half, 2 * half))
    points = grid.nodes().numpy()
    distance = np.hypot(points[:, 0], points[:, 1])
    angle = np.linspace(0, 2 * np.pi, int(2 * np.pi * RADIUS / spacing), endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    normals = np.concatenate([ring] * 7)
    places = RADIUS * normals + np.repeat(np.arange(7) * spacing, len(ring))[:, None] * [0, 0, 1]
    label = np.zeros(len(places), np.uint8)
    wall = geometry.WallPoints(places, normals, np.zeros_like(places), np.ones(len(places)), label)
    return grid, distance, (distance < RADIUS).reshape(grid.shape), wall


def along(grid, mask, values):
    field = np.zeros((3, *grid.shape))
    field[2] = values.reshape(grid.shape) * mask
    return field


def test_poiseuille_is_exact():
    """tau = rho f R / 2, along the flow: what drags the wall."""
    grid, distance, mask, wall = pipe(1.25e-3)
    speed = pipe_flow(torch.from_numpy(distance), 1e-5, 2.0, RADIUS).numpy()
    stress = WallShear(grid, mask, wall).stress(along(grid, mask, speed), 1e-5 * RHO)
    np.testing.assert_allclose(stress, np.tile([0, 0, RHO * 2.0 * RADIUS / 2], (len(stress), 1)), atol=1e-9)


def oscillating(spacing, layer):
    """Found and exact stress over half a period, for a shear layer of thickness sqrt(2 nu / w) = `layer` (m)."""
    frequency = 2.0
    viscosity = 0.5 * layer**2 * 2 * np.pi * frequency
    grid, distance, mask, wall = pipe(spacing)
    shear = WallShear(grid, mask, wall)

    def speed(radius, time):
        return womersley(torch.as_tensor(radius), time, viscosity, 2.0, frequency, RADIUS).numpy()

    def parts(time):
        found = shear.stress(along(grid, mask, speed(distance, time)), RHO * viscosity)[:, 2].mean()
        return found, RHO * viscosity * speed(np.array([RADIUS - 1e-7]), time).item() / 1e-7

    return np.array([parts(time) for time in np.linspace(0, 0.25, 9)]).T


def test_womersley_converges():
    spacings, errors = [1.25e-3, 8e-4, 5e-4], []
    for spacing in spacings:
        found, exact = oscillating(spacing, 2.5e-3)
        errors.append(np.sqrt(np.mean((found - exact) ** 2) / np.mean(exact**2)))
    assert order(spacings, errors) > 1.5 and errors[-1] < 0.03


def test_thin_layers_are_lost():
    """The table in `wall_shear.py`: share of the amplitude that is found with layers of 2, 1 and 1/2 spacings."""
    shares = []
    for layer in (2.0, 1.0, 0.5):
        found, exact = oscillating(8e-4, layer * 8e-4)
        shares.append(np.abs(found).max() / np.abs(exact).max())
    assert shares == pytest.approx([0.99, 0.92, 0.71], abs=0.03)
