"""What the tests of formats share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from geometry import Grid, Recording


def flow(points: np.ndarray, time: float) -> np.ndarray:
    x, y, z = (points - 0.004).T
    return np.stack([40 * x - 9 * y + time, 10 * x + 20 * y, -60 * z + 5 * x], axis=1) + [0.05, 0.1, -0.2]


@pytest.fixture(name="recording")
def _recording(box_recording: Callable[..., Recording]) -> Recording:
    """Different counts, spacings and origins along x, y and z, a moving wall and a weight."""
    box = box_recording(flow, times=(0.1, 0.12, 0.14), wall_velocity=lambda vertices: 0.1 * vertices)
    grid = Grid((-0.001, 0.0, 0.001), (0.001, 0.0012, 0.0015), (5, 7, 9))
    points = grid.nodes().numpy()
    mask = ((points > 0) & (points < 0.01)).all(axis=1).reshape(grid.shape)
    velocity = np.stack([flow(points, t).T.reshape(3, *grid.shape) * mask for t in box.time])
    weight = np.broadcast_to(np.linspace(0.2, 1, 9), (3, *grid.shape))
    return replace(box, grid=grid, velocity=velocity, mask=mask, weight=weight)
