"""Planes cut out of volumes: exact sections of an ellipsoid that moves, with its openings and velocities."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import geometry
from geometry import Grid, Recording, RecordingError, Wall, plane_cut

HALF = np.array([0.008, 0.006, 0.012])  # m
GROWTH = np.array([4.0, -2.0, 3.0])  # 1/s: x (1 + g t) along each axis


@pytest.fixture(name="volume", scope="module")
def _volume() -> Recording:
    """An ellipsoid whose caps beyond 80 % of its length are openings, stretched with the flow inside."""
    body = geometry.ellipsoid(tuple(HALF), 0.8e-3)
    height = body.centroids[:, 2] / HALF[2]
    region = np.where(height > 0.8, 2, np.where(height < -0.8, 1, 0)).astype(np.uint8)
    time = np.array([0.0, 0.01, 0.02])
    grid = Grid((-0.012, -0.008, -0.016), (1e-3,) * 3, (33, 17, 25))
    nodes = grid.nodes().numpy()
    masks, fields = [], []
    for t in time:
        masks.append(((nodes / (HALF * (1 + GROWTH * t))) ** 2).sum(1).reshape(grid.shape) < 1)
        fields.append((nodes * GROWTH / (1 + GROWTH * t)).T.reshape(3, *grid.shape) * masks[-1])
    vertices = np.stack([body.vertices * (1 + GROWTH * t) for t in time])
    wall = Wall(vertices, body.faces, region, velocity=np.stack([body.vertices * GROWTH] * 3))
    return Recording(
        time,
        grid,
        np.stack(fields),
        np.stack(masks),
        wall,
        1060.0,
        0.004,
        weight=np.stack(masks),
        valve_intervals=np.array([[1, 0.0, 0.01], [2, 0.01, 0.02], [1, 0.015, 0.02]]),
    )


def test_the_section_is_an_ellipse_that_moves_as_the_wall_does(volume: Recording) -> None:
    plane = plane_cut(volume, (0, 0, 0), (1, 0, 0), (0, 0, 1))
    plane.check()
    assert plane.cut and plane.dimension == 2
    motion = geometry.WallMotion.from_recording(plane)
    for frame, t in enumerate(volume.time):
        half = (HALF * (1 + GROWTH * t))[[0, 2]]
        assert np.linalg.norm(plane.wall.vertices[frame] / half, axis=1) == pytest.approx(1, abs=0.02)
        assert motion.volume(t) == pytest.approx(np.pi * half.prod(), rel=0.02)
        np.testing.assert_allclose(plane.wall.velocity[frame], plane.wall.vertices[0] * GROWTH[[0, 2]], atol=4e-4)
    height = plane.wall.at(0).centroids[:, 1] / HALF[2]
    assert set(plane.wall.region[height > 0.85]) == {2} and set(plane.wall.region[height < -0.85]) == {1}
    assert set(plane.wall.region[np.abs(height) < 0.7]) == {0}
    np.testing.assert_array_equal(plane.valve_intervals, volume.valve_intervals)


def test_velocities_are_those_in_the_plane(volume: Recording) -> None:
    turn = np.deg2rad(30)
    right, up = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([0.3, 0.1, 1.0])
    plane = plane_cut(volume, (0.001, 0, 0.002), right, up, spacing=0.8e-3)
    up = up - (up @ right) * right
    up /= np.linalg.norm(up)
    nodes = np.array([0.001, 0, 0.002]) + plane.grid.nodes().numpy() @ np.stack([right, up])
    t = volume.time[1]
    inner = plane.mask[1].reshape(-1) & (((nodes / (HALF * (1 + GROWTH * t))) ** 2).sum(1) < 0.6)
    expected = nodes * GROWTH / (1 + GROWTH * t) @ np.stack([right, up]).T
    found = plane.velocity[1].reshape(2, -1).T
    assert inner.sum() > 100
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-4)
    assert plane.weight.max() <= 1


def test_a_plane_that_meets_no_opening_or_no_wall(volume: Recording) -> None:
    level = plane_cut(volume, (0, 0, 0), (1, 0, 0), (0, 1, 0))
    assert set(level.wall.region) == {0} and len(level.valve_intervals) == 0
    with pytest.raises(ValueError, match="does not meet the walls"):
        plane_cut(volume, (0, 0, 0.1), (1, 0, 0), (0, 1, 0))
    with pytest.raises(ValueError, match="must span a plane"):
        plane_cut(volume, (0, 0, 0), (1, 0, 0), (2, 0, 0))
    with pytest.raises(ValueError, match="is a plane already"):
        plane_cut(level, (0, 0, 0), (1, 0, 0), (0, 1, 0))


def test_the_file_says_that_it_is_a_cut(volume: Recording, tmp_path: Path) -> None:
    plane = plane_cut(volume, (0, 0, 0), (1, 0, 0), (0, 0, 1))
    for cut in (True, False):
        geometry.write_recording(tmp_path / "plane.h5", replace(plane, cut=cut))
        assert geometry.read_recording(tmp_path / "plane.h5").cut is cut
    with pytest.raises(RecordingError, match="attribute cut: .*but this is a volume"):
        replace(volume, cut=True).check()
    with pytest.raises(TypeError, match="cut must be"):
        replace(plane, cut=1)
