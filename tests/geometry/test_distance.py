"""Signed distance: exact on boxes, on ellipsoids against root finding, on meshes against trimesh."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import brentq

from geometry import (
    Grid,
    MovingDistance,
    Surface,
    SurfaceError,
    SurfaceIndex,
    WallMotion,
    box,
    distance_and_closest,
    ellipse,
    ellipsoid,
    polygon,
    signed_distance,
    winding_number,
)


def _ellipsoid_distance(axes: np.ndarray, point: np.ndarray) -> float:
    """Signed distance (positive inside) by the root of the closest point's equation (Eberly 2013, eq. 26)."""
    axes = np.asarray(axes, float)
    low = -(axes.min() ** 2) + axes.min() * np.abs(point[axes.argmin()])
    high = -(axes.min() ** 2) + np.linalg.norm(axes * point)
    root = brentq(lambda t: ((axes * point / (t + axes**2)) ** 2).sum() - 1, low - 1e-12, high + 1e-12)
    closest = axes**2 * point / (root + axes**2)
    inside = ((point / axes) ** 2).sum() < 1
    return float(np.linalg.norm(point - closest)) * (1 if inside else -1)


def _box_distance(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    gap = np.maximum(lower - points, points - upper)
    outside = np.linalg.norm(np.maximum(gap, 0), axis=1)
    return np.where(gap.max(1) > 0, -outside, -gap.max(1))


@pytest.mark.parametrize("band", [None, 0.25])
def test_a_box_is_exact(band: float | None) -> None:
    lower, upper = np.array([0.1, 0.2, 0.3]), np.array([1.1, 1.0, 1.2])
    grid = Grid.covering((-0.2, -0.2, -0.2), (1.4, 1.4, 1.4), 0.1)
    expected = _box_distance(grid.nodes().numpy(), lower, upper).reshape(grid.shape)
    distance = signed_distance(grid, box(lower, upper, 0.3), band=band)
    near = np.abs(expected) <= (np.inf if band is None else band)
    np.testing.assert_allclose(distance[near], expected[near], atol=1e-15)
    np.testing.assert_allclose(distance, expected, atol=1e-15 if band is None else 0.1)


def test_a_square_is_exact_in_the_plane() -> None:
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    grid = Grid.covering((-0.55, -0.55), (1.55, 1.55), 0.1)
    expected = _box_distance(grid.nodes().numpy(), np.zeros(2), np.ones(2)).reshape(grid.shape)
    for cut in (5.0, 0.3, 0.01):
        np.testing.assert_allclose(signed_distance(grid, polygon(corners, cut)), expected, atol=1e-15)


def test_an_ellipsoid_is_accurate_to_a_hundredth_of_the_spacing() -> None:
    axes, spacing = np.array([9.0, 7.0, 16.0]) * 1e-3, 1e-3
    grid = Grid.covering(tuple(-axes - 2e-3), tuple(axes + 2e-3), spacing)
    surface = ellipsoid(axes, 0.5 * spacing)
    found = distance_and_closest(grid, surface, band=3 * spacing)
    nodes, distance = grid.nodes().numpy(), found.distance.ravel()
    rows = np.flatnonzero(np.abs(distance) < 3 * spacing)[::19]
    # In millimetres, so that the bracket's margin of 1e-12 is round-off.
    expected = 1e-3 * np.array([_ellipsoid_distance(1e3 * axes, 1e3 * nodes[row]) for row in rows])
    assert len(rows) > 400 and (expected > 0).any() and (expected < 0).any()
    assert np.abs(distance[rows] - expected).max() < 0.01 * spacing
    # The normal: towards the closest point of the ellipsoid, where that is not lost in round-off.
    away = np.abs(expected) > 0.2 * spacing
    normal = (nodes[rows] - found.closest.point(surface)[rows]) / distance[rows, None]
    gradient = -(found.closest.point(surface)[rows] / axes**2)
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.clip((normal * gradient).sum(1)[away], -1, 1))).max() < 3.0


def test_any_closest_point_equals_a_search_over_all_faces() -> None:
    draw = np.random.default_rng(0)
    # Sizes of faces that differ a thousandfold, and slivers: a sphere squeezed and stretched unevenly.
    sphere = ellipsoid((1.0, 1.0, 1.0), 0.25)
    vertices = sphere.vertices * np.array([1.0, 0.05, 1.0]) * np.exp(2 * sphere.vertices[:, :1])
    surface = Surface(vertices, sphere.faces)
    points = draw.uniform(-1.5, 4.0, (300, 3))
    found = SurfaceIndex(surface).query(points)
    triangles = vertices[surface.faces]
    for row in range(0, 300, 3):
        nearest = trimesh.triangles.closest_point(triangles, np.repeat(points[row : row + 1], len(triangles), axis=0))
        best = np.linalg.norm(nearest - points[row], axis=1).min()
        assert found.distance[row] == pytest.approx(best, rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(found.weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found.point(surface) - points, axis=1), found.distance, rtol=1e-12)


def test_points_of_the_surface_have_no_distance() -> None:
    surface = ellipsoid((1.0, 2.0, 0.5), 0.2)
    found = SurfaceIndex(surface).query(np.concatenate([surface.vertices, surface.centroids]))
    assert found.distance.max() < 1e-15


def test_the_resolution_changes_no_result() -> None:
    surface, points = box((0, 0, 0), (1, 1, 1), 1.0), np.random.default_rng(1).uniform(-1, 2, (200, 3))
    one, other = SurfaceIndex(surface).query(points), SurfaceIndex(surface, resolution=0.02).query(points)
    np.testing.assert_allclose(one.distance, other.distance, atol=1e-15)


def test_the_sign_holds_where_normals_fail() -> None:
    # A wedge of 10 degrees: the closest face of many points beyond its edge looks towards them.
    corner = np.array([[0, 0], [1, -0.0875], [1, 0.0875]])
    grid = Grid.covering((-0.3, -0.3), (1.3, 0.3), 0.03)
    distance = signed_distance(grid, polygon(corner, 0.05)).ravel()
    inside = winding_number(corner, np.array([[0, 1], [1, 2], [2, 0]]), grid.nodes().numpy()) > 0.5
    np.testing.assert_array_equal(distance > 0, inside)


def test_bad_arguments_are_refused() -> None:
    grid, sphere = Grid((0.0,) * 3, (1.0,) * 3, (3, 3, 3)), ellipsoid((1.0, 1.0, 1.0), 0.5)
    with pytest.raises(SurfaceError, match="not closed"):
        signed_distance(grid, Surface(sphere.vertices, sphere.faces[1:]))
    with pytest.raises(ValueError, match="a 2-D surface on a 3-D grid"):
        signed_distance(grid, ellipse((1.0, 1.0), 0.1))
    with pytest.raises(ValueError, match="band must be positive"):
        signed_distance(grid, sphere, band=0.0)
    with pytest.raises(ValueError, match="points must be finite"):
        SurfaceIndex(sphere).query(np.array([[np.nan, 0, 0]]))


def _drifting_box(speed: np.ndarray, times: np.ndarray) -> WallMotion:
    brick = box((0, 0, 0), (1, 1, 1), 0.5)
    return WallMotion.through(times, brick.vertices + times[:, None, None] * speed, brick.faces, brick.region)


@pytest.mark.parametrize("frames", [2, 5])
def test_a_box_that_moves_several_spacings_between_frames_stays_exact(frames: int) -> None:
    speed = np.array([0.8, 0.0, 0.0])
    motion = _drifting_box(speed, np.linspace(0, 1, frames))
    grid = Grid.covering((-0.5, -0.5, -0.5), (2.5, 1.5, 1.5), 0.1)
    moving = MovingDistance(grid, motion, dtype=torch.float64)
    points = torch.tensor([[0.7, 0.45, 0.5], [0.9, 0.5, 0.55], [1.25, 0.5, 0.5]], dtype=torch.float64)
    for t in (0.0, 0.13, 0.5, 0.77, 1.0):
        wall = moving.at(t).at(points)
        low = speed * t
        expected = _box_distance(points.numpy(), low, low + 1)
        # Grids are made wherever the wall has moved one spacing: the error stays at a few percent of it.
        np.testing.assert_allclose(wall.distance, expected, atol=0.03)
        np.testing.assert_allclose(wall.velocity, np.broadcast_to(speed, (3, 3)), atol=1e-9)
    assert np.diff(moving.key_times.times).max() * speed[0] <= 0.1 + 1e-9


def test_the_interpolated_distance_normal_and_velocity_of_a_growing_sphere() -> None:
    sphere, times = ellipsoid((1.0, 1.0, 1.0), 0.04), np.linspace(0, 1, 2)
    motion = WallMotion.through(times, sphere.vertices * (1 + 0.3 * times[:, None, None]), sphere.faces, sphere.region)
    spacing = 0.15
    grid = Grid.covering((-1.6,) * 3, (1.6,) * 3, spacing)
    moving = MovingDistance(grid, motion, band=0.5)
    draw = np.random.default_rng(2)
    direction = draw.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for t in (0.1, 0.25):
        radius = 1 + 0.3 * t
        points = direction * (radius + draw.uniform(-0.25, 0.25, (200, 1)))
        wall = moving.at(t).at(torch.as_tensor(points, dtype=torch.float32))
        expected = radius - np.linalg.norm(points, axis=1)
        assert np.abs(wall.distance.numpy() - expected).max() < 0.01 * spacing
        assert np.abs(wall.normal.numpy() + direction).max() < 0.04
        np.testing.assert_allclose(np.linalg.norm(wall.normal, axis=1), 1, atol=1e-5)
        assert np.abs(wall.velocity.numpy() - 0.3 * direction).max() < 0.02
        torch.testing.assert_close(moving.distance(torch.as_tensor(points).float(), t), wall.distance)


def test_old_grids_are_forgotten_and_remade_alike() -> None:
    motion = _drifting_box(np.array([0.1, 0.0, 0.0]), np.linspace(0, 1, 5))
    grid = Grid.covering((-0.3, -0.3, -0.3), (1.5, 1.3, 1.3), 0.2)
    moving = MovingDistance(grid, motion, keep=2)
    first = moving.at(0.1).table.clone()
    for t in (0.3, 0.6, 0.9):
        moving.at(t)
    assert len(moving._tables) == 2
    assert torch.equal(moving.at(0.1).table, first)


def test_a_wall_at_rest_is_valid_at_every_time() -> None:
    grid = Grid.covering((-0.3, -0.3, -0.3), (1.3, 1.3, 1.3), 0.1)
    moving = MovingDistance(grid, WallMotion.at_rest(box((0, 0, 0), (1, 1, 1), 0.5)), dtype=torch.float64)
    point = torch.tensor([[0.5, 0.5, 0.2]], dtype=torch.float64)
    for t in (-5.0, 0.0, 1e3):
        assert moving.distance(point, t).item() == pytest.approx(0.2)
        assert moving.wall_velocity(point, t).abs().max() == 0
        torch.testing.assert_close(moving.normal(point, t), torch.tensor([[0.0, 0, 1]], dtype=torch.float64))


def test_moving_distance_refuses_bad_options() -> None:
    motion = _drifting_box(np.zeros(3), np.array([0.0, 1.0]))
    with pytest.raises(ValueError, match="a 3-D wall on a 2-D grid"):
        MovingDistance(Grid((0.0, 0.0), (1.0, 1.0), (3, 3)), motion)
    with pytest.raises(ValueError, match="MovingDistance: keep must be from 2"):
        MovingDistance(Grid((0.0,) * 3, (1.0,) * 3, (3, 3, 3)), motion, keep=1)
