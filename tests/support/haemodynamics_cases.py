"""Exact flows on masked grids, and the order of convergence, for the tests of what is read out of a flow."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import geometry
from torchsph.haemodynamics.fields.derivatives import WallSamples


def ball(spacing: float, radius: float = 1.0) -> tuple[geometry.Grid, np.ndarray, np.ndarray]:
    """A grid around a ball, its points (n, 3) and the mask (*shape); no node lies on a plane of symmetry."""
    half = np.ceil(radius / spacing) + 0.63
    count = int(2 * half) + 2
    grid = geometry.Grid((-half * spacing,) * 3, (spacing,) * 3, (count,) * 3)
    points = grid.nodes().numpy()
    return grid, points, ((points**2).sum(1) < radius**2).reshape(grid.shape)


def on_grid(grid: geometry.Grid, values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Values (n, *components) of the nodes as (*components, *shape), 0 outside the mask."""
    return np.moveaxis(values.reshape(*grid.shape, *values.shape[1:]), range(3), range(-3, 0)) * mask


def sphere_points(spacing: float, radius: float = 1.0) -> np.ndarray:
    """Points (n, 3) about `spacing` apart on a sphere (Fibonacci lattice)."""
    count = int(4 * np.pi * radius**2 / spacing**2) + 8
    number = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * number / count), np.pi * (1 + 5**0.5) * number
    return radius * np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], 1)


def sphere_wall(spacing: float, velocity: Callable[[np.ndarray], np.ndarray], radius: float = 1.0) -> WallSamples:
    """Wall samples of a sphere at which `velocity` (n, 3) -> (n, 3) holds."""
    points = sphere_points(spacing, radius)
    return WallSamples(points, velocity(points))


def order(spacings: list[float], errors: list[float]) -> float:
    """Slope of log(error) over log(spacing): the order of convergence."""
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])


def hill_vortex(points: np.ndarray, speed: float = 1.0, radius: float = 1.0) -> np.ndarray:
    """Velocity (n, 3) inside Hill's spherical vortex at rest, along z (Hill 1894; Batchelor 1967 sec. 7.2)."""
    x, y, z = points.T
    square = x**2 + y**2
    along = 1.5 * speed * (1 - (2 * square + z**2) / radius**2)
    across = 1.5 * speed * z / radius**2
    return np.stack([across * x, across * y, along], 1)


def hill_vorticity(points: np.ndarray, speed: float = 1.0, radius: float = 1.0) -> np.ndarray:
    """Vorticity (n, 3) of `hill_vortex`: 15/2 U r / a^2 around the axis."""
    x, y, _ = points.T
    strength = 7.5 * speed / radius**2
    return strength * np.stack([-y, x, np.zeros_like(x)], 1)


def walls_of_box(size: float, step: float, rise: float) -> geometry.WallPoints:
    """Points of a box: the lid is region 1 where x < size / 2 and region 2 beyond; the bottom rises."""
    line = step * (np.arange(round(size / step)) + 0.5)
    one, other = (part.ravel() for part in np.meshgrid(line, line))
    points, normals, velocities, region = [], [], [], []
    for axis in range(3):
        for end in (0.0, size):
            side = np.insert(np.stack([one, other], 1), axis, end, axis=1)
            points.append(side)
            normals.append(np.tile((1.0 if end else -1.0) * np.eye(3)[axis], (len(side), 1)))
            bottom = axis == 2 and not end
            velocities.append(np.tile([0.0, 0.0, rise * bottom], (len(side), 1)))
            lid = np.where(side[:, 0] < size / 2, 1, 2) if axis == 2 and end else np.zeros(len(side), int)
            region.append(lid)
    areas = np.full(6 * len(one), step**2)
    parts = (np.concatenate(each) for each in (points, normals, velocities))
    return geometry.WallPoints(*parts, areas, np.concatenate(region))
