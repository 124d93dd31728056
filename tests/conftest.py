"""What tests share: which copy of the packages is under test, and recordings whose answers are known."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# One thread a process, children included, told before torch counts the cores: threads that wait for one another on a
# busy machine cost many times what they save. Tests that are about threads set their number.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def _prefer_installed() -> None:
    """Test what was installed: `python -m pytest` puts the checkout first, which has no compiled kernels.

    It comes last, so that processes that a test starts find the test by its name.
    """
    elsewhere = [entry for entry in sys.path if Path(entry or os.getcwd()).resolve() != ROOT]
    if any(metadata.distributions(name="torchsph", path=elsewhere)):
        sys.path[:] = [*elsewhere, str(ROOT)]


_prefer_installed()

import numpy as np  # noqa: E402
from paths import SHARED_DATA  # noqa: E402

import geometry  # noqa: E402


def pytest_report_header() -> str:
    """Say which copy of the packages is under test."""
    return f"packages under test: {Path(geometry.__file__).resolve().parents[1]}"


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip, with the reason, what needs a file of the phantom that this machine lacks: see the marker `phantom`."""
    for marker in item.iter_markers("phantom"):
        missing = [name for name in marker.args if not (SHARED_DATA / name).is_file()]
        if missing or not marker.args:
            assert marker.args, f"{item.nodeid}: the marker phantom names the files that are needed"
            pytest.skip(f"needs {', '.join(missing)} in {SHARED_DATA}: the phantom lies beside the checkout, not in it")


def box_surface(dimension: int, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The box [0, size]^D: vertices, outward faces, regions; the side of the highest z (y) is orifice 1."""
    if dimension == 2:
        vertices = size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        return (
            vertices,
            np.array([[0, 1], [1, 2], [2, 3], [3, 0]], np.int32),
            np.array([0, 0, 1, 0], np.uint8),
        )
    vertices = size * np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)], float)
    quads = [(0, 2, 3, 1), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), (4, 5, 7, 6)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return vertices, np.array(faces, np.int32), np.array([0] * 10 + [1] * 2, np.uint8)


def box_recording(
    velocity: Callable[[np.ndarray, float], np.ndarray],
    *,
    dimension: int = 3,
    size: float = 0.01,
    nodes: int = 8,
    times: tuple[float, ...] = (0.0, 0.01, 0.02),
    wall_velocity: Callable[[np.ndarray], np.ndarray] | None = None,
    **more: object,
) -> geometry.Recording:
    """A recording of `velocity(points (n, D), time) -> (n, D)` in a box with nodes half a cell off the walls.

    `wall_velocity(vertices) -> (nv, D)` moves the walls steadily; without it they stand still.
    """
    step = size / nodes
    grid = geometry.Grid((-0.5 * step,) * dimension, (step,) * dimension, (nodes + 2,) * dimension)
    points = grid.nodes().numpy()
    mask = ((points > 0) & (points < size)).all(1).reshape(grid.shape)
    frames = [velocity(points, t).T.reshape(dimension, *grid.shape) * mask for t in times]
    corners, faces, region = box_surface(dimension, size)
    drift = np.zeros_like(corners) if wall_velocity is None else wall_velocity(corners)
    wall = geometry.Wall(
        vertices=np.stack([corners + t * drift for t in times]),
        faces=faces,
        region=region,
        velocity=np.stack([drift] * len(times)),
    )
    return geometry.Recording(
        time=np.array(times),
        grid=grid,
        velocity=np.stack(frames),
        mask=mask,
        wall=wall,
        rho=1060.0,
        mu=0.004,
        **more,
    )


@pytest.fixture(name="box_recording")
def _box_recording() -> Callable[..., geometry.Recording]:
    return box_recording
