"""Planes cut out of volumes: exact sections of an ellipsoid that moves, with its openings and velocities."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import geometry
import regularize
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


VIEWS = [np.deg2rad(degrees) for degrees in (0, 60, 120)]


@pytest.fixture(name="views", scope="module")
def _views(volume: Recording) -> list[geometry.PlacedPlane]:
    """Three planes through the long axis."""
    placed = []
    for turn in VIEWS:
        place, right, up = (0.0, 0.0, -0.01), (float(np.cos(turn)), float(np.sin(turn)), 0.0), (0.0, 0.0, 1.0)
        placed.append(geometry.PlacedPlane(plane_cut(volume, place, right, up), place, right, up))
    return placed


def test_planes_put_back_hold_the_flow_within_them(volume: Recording, views: list[geometry.PlacedPlane]) -> None:
    whole = geometry.planes_in_space(volume, views)
    whole.check()
    nodes, seen = volume.grid.nodes().numpy(), (whole.weight[1] > 0.99).reshape(-1)
    normals = np.stack([[-np.sin(turn), np.cos(turn), 0.0] for turn in VIEWS])
    away = np.abs(nodes @ normals.T)
    assert seen.sum() > 500 and away[seen].min(1).max() <= 0.5e-3 + 1e-12
    nearest = normals[away.argmin(1)]
    alone = seen & (np.sort(away, 1)[:, 1] > 0.6e-3)  # not on the axis, where planes cross
    deep = alone & (((nodes / (HALF * (1 + GROWTH * volume.time[1]))) ** 2).sum(1) < 0.6)
    assert deep.sum() > 200
    flow = nodes * GROWTH / (1 + GROWTH * volume.time[1])
    foot = (nodes - (nodes * nearest).sum(1, keepdims=True) * nearest) * GROWTH / (1 + GROWTH * volume.time[1])
    within = foot - (foot * nearest).sum(1, keepdims=True) * nearest
    found = whole.velocity[1].reshape(3, -1).T
    np.testing.assert_allclose(found[deep], within[deep], atol=2e-4)
    assert np.abs((found * nearest).sum(1)[alone]).max() < 1e-6 < np.abs(flow).max()
    kind = geometry.measurement_type(whole)
    parts = kind.components(np.broadcast_to(found.T.reshape(3, *volume.grid.shape), volume.velocity.shape))
    size = np.sqrt((parts[1] ** 2).sum(0)).reshape(-1)
    np.testing.assert_allclose(size[deep], np.linalg.norm(within[deep], axis=1), atol=2e-4)


def test_splines_of_planes_know_the_space_between(volume: Recording, views: list[geometry.PlacedPlane]) -> None:
    """A field of uniform gradient has no curvature: two components in three planes and no divergence fix all of it."""
    shear = np.array([[6.0, 0.0, 5.0], [0.0, 2.0, 0.0], [3.0, 0.0, -8.0]])
    nodes = volume.grid.nodes().numpy()
    mask = np.asarray(volume.mask[:1])
    flow = (nodes @ shear.T).T.reshape(1, 3, *volume.grid.shape)
    still = replace(volume.select([0]), wall=volume.wall.select(np.array([0])), velocity=flow * mask)
    planes = [
        geometry.PlacedPlane(plane_cut(still, view.origin, view.right, view.up), view.origin, view.right, view.up)
        for view in views
    ]
    whole = geometry.planes_in_space(still, planes)
    used = torch.from_numpy((whole.weight[0] > 0.99).reshape(-1))
    points = whole.grid.nodes()
    rows = (
        geometry.measurement_type(whole)
        .at(0, torch.nonzero(used)[:, 0])
        .spline_rows(
            points[used],
            torch.from_numpy(whole.velocity[0].reshape(3, -1).T[used.numpy()]).double(),
            used[used].double(),
        )
    )
    inside = points[torch.from_numpy(mask.reshape(-1))]
    smoother = regularize.Smoother(spacing=(3e-3,) * 3).fixed(curvature=1e-3)
    fitted = smoother.fit(*rows[:3], divergence_points=inside, beam=rows[3])
    found = fitted(inside).numpy()
    exact = inside.numpy() @ shear.T
    assert np.sqrt(np.square(found - exact).sum() / np.square(exact).sum()) < 0.1


def test_planes_that_cannot_be_put_back_are_refused(volume: Recording, views: list[geometry.PlacedPlane]) -> None:
    with pytest.raises(ValueError, match="at least one plane"):
        geometry.planes_in_space(volume, [])
    with pytest.raises(RecordingError, match="/time"):
        geometry.planes_in_space(volume.select([0, 1]), views)
    with pytest.raises(RecordingError, match="near any plane"):
        geometry.planes_in_space(volume, [replace(views[0], origin=(0.0, 0.5, 0.0))])
    with pytest.raises(ValueError, match="both components"):
        geometry.planes_in_space(volume, [geometry.PlacedPlane(volume, (0, 0, 0), (1, 0, 0), (0, 0, 1))])
    whole = geometry.planes_in_space(volume, views)
    with pytest.raises(RecordingError, match="/normal: must hold unit vectors"):
        replace(whole, normal=2 * whole.normal).check()
    with pytest.raises(RecordingError, match="/normal: is of planes"):
        replace(whole, nyquist=np.ones(volume.frames)).check()


def test_planes_in_space_as_a_file(tmp_path: Path, volume: Recording, views: list[geometry.PlacedPlane]) -> None:
    whole = geometry.planes_in_space(volume, views)
    geometry.write_recording(tmp_path / "planes.h5", whole)
    read = geometry.read_recording(tmp_path / "planes.h5")
    np.testing.assert_array_equal(read.normal, whole.normal)
    assert read.with_velocity(read.velocity).normal is None
