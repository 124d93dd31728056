"""Surfaces from points, masks and velocities: volumes, concavity, cavities, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from geometry import (
    Grid,
    SurfaceError,
    Ventricle,
    ellipsoid,
    signed_distance,
    surface_from_mask,
    surface_from_points,
    surface_from_velocity,
    taubin,
)

GRID = Grid.covering((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2), 0.12)
NODES = GRID.nodes().numpy()
RADIUS = np.linalg.norm(NODES, axis=1)


def _torus(points: np.ndarray) -> np.ndarray:
    return (np.hypot(points[:, 0], points[:, 1]) - 0.75) ** 2 + points[:, 2] ** 2 < 0.35**2


@pytest.mark.parametrize(
    ("inside", "volume"),
    [(RADIUS < 1, 4 / 3 * np.pi), (_torus(NODES), 2 * np.pi**2 * 0.75 * 0.35**2)],
    ids=["sphere", "torus"],
)
def test_the_volume_of_a_mask_is_kept_with_its_concavities(inside: np.ndarray, volume: float) -> None:
    surface = surface_from_mask(inside.reshape(GRID.shape), GRID)
    surface.check()
    assert surface.volume == pytest.approx(volume, rel=0.1)  # a cell is a sixth of the torus
    assert surface.volume == pytest.approx(inside.sum() * GRID.cell_volume, rel=0.02)


def test_the_surface_of_a_mask_lies_between_its_nodes_and_the_rest() -> None:
    inside = _torus(NODES).reshape(GRID.shape)
    distance = signed_distance(GRID, surface_from_mask(inside, GRID))
    np.testing.assert_array_equal(distance > 0, inside)
    edge = 0.5 * GRID.spacing[0]
    assert np.abs(distance).min() > 0.2 * edge and distance.max() < 0.35 + edge


def test_alpha_sets_how_wide_a_concavity_must_be() -> None:
    points = NODES[_torus(NODES)]
    tight, hull = surface_from_points(points, alpha=0.2), surface_from_points(points, alpha=np.inf)
    hull.check()
    assert hull.volume == pytest.approx(ConvexHull(points).volume, rel=1e-6)
    assert tight.volume < 0.8 * hull.volume
    grid = Grid((-0.05,) * 3, (0.05,) * 3, (3, 3, 3))
    assert signed_distance(grid, hull).max() > 0.2 and signed_distance(grid, tight).max() < 0


def test_cavities_are_filled_and_the_largest_body_taken() -> None:
    shell = (RADIUS < 1) & (RADIUS > 0.4)
    apart = np.linalg.norm(NODES - 1.1, axis=1) < 0.2
    surface = surface_from_mask((shell | apart).reshape(GRID.shape), GRID)
    surface.check()
    assert len(np.unique(surface.component_labels)) == 1
    assert surface.volume == pytest.approx(4 / 3 * np.pi, rel=0.04)
    cloud = surface_from_points(NODES[shell | apart], alpha=0.15)
    cloud.check()
    assert len(np.unique(cloud.component_labels)) == 1 and cloud.volume > 3


def test_a_mask_up_to_the_edge_of_the_grid_is_closed_there() -> None:
    surface = surface_from_mask(np.ones((3, 4, 5), bool), Grid((0.0,) * 3, (1.0,) * 3, (3, 4, 5)))
    surface.check()
    assert surface.bounds[0].tolist() == [-0.5] * 3 and surface.bounds[1].tolist() == [4.5, 3.5, 2.5]


def test_planes_are_segmented_alike() -> None:
    grid = Grid.covering((-1.2, -1.2), (1.2, 1.2), 0.05)
    nodes = grid.nodes().numpy()
    notched = (np.linalg.norm(nodes, axis=1) < 1) & ~((nodes[:, 0] > 0) & (np.abs(nodes[:, 1]) < 0.3))
    surface = surface_from_mask(notched.reshape(grid.shape), grid)
    surface.check()
    assert surface.volume == pytest.approx(notched.sum() * grid.cell_volume, rel=0.01)


def test_velocity_thresholding_finds_the_ventricle() -> None:
    shape = Ventricle()
    recording = shape.recording([0.05, 0.1], grid_spacing=1.5e-3, velocity=lambda p, t: np.full_like(p, 0.1))
    one = surface_from_velocity(recording.velocity[0], recording.grid)
    one.check()
    assert one.volume == pytest.approx(recording.mask[0].sum() * 1.5e-3**3, rel=0.02)
    # In the earlier, larger frame more nodes move: the union of both is that frame.
    both = surface_from_velocity(recording.velocity, recording.grid)
    assert both.volume == pytest.approx(one.volume, rel=1e-9)
    with pytest.raises(SurfaceError, match="no node is inside"):
        surface_from_velocity(recording.velocity, recording.grid, threshold=1.0)


def test_smoothing_takes_the_steps_out_without_shrinking() -> None:
    inside = (RADIUS < 1).reshape(GRID.shape)
    rough, smooth = surface_from_mask(inside, GRID), surface_from_mask(inside, GRID, smoothing=8)
    smooth.check()
    assert smooth.volume == pytest.approx(rough.volume, rel=0.01)
    tilt = []
    for surface in (rough, smooth):
        cosine = (surface.normals * surface.centroids).sum(1) / np.linalg.norm(surface.centroids, axis=1)
        tilt.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
    assert tilt[1] < 0.7 * tilt[0]
    ball = ellipsoid((1.0, 1.0, 1.0), 0.2)
    assert taubin(ball, 5).volume == pytest.approx(ball.volume, rel=0.01)


def test_the_result_does_not_depend_on_the_order_of_points() -> None:
    points = NODES[RADIUS < 0.8]
    order = np.random.default_rng(0).permutation(len(points))
    one, other = surface_from_points(points, alpha=0.12), surface_from_points(points[order], alpha=0.12)
    assert one.volume == pytest.approx(other.volume, rel=1e-6)


@pytest.mark.parametrize(
    ("points", "alpha", "message"),
    [
        (np.zeros((2, 3)), 1.0, "cannot be triangulated"),
        (np.c_[np.random.default_rng(0).random((20, 2)), np.zeros(20)], 1e-3, "no simplex is as small"),
        (np.zeros((5, 4)), 1.0, "points must be finite"),
        (np.full((5, 3), np.nan), 1.0, "points must be finite"),
        (NODES, 0.0, "alpha must be a positive length"),
        (NODES, 0.01, "no simplex is as small as alpha"),
    ],
)
def test_bad_clouds_are_refused(points: np.ndarray, alpha: float, message: str) -> None:
    with pytest.raises(SurfaceError, match=message):
        surface_from_points(points, alpha=alpha)


def test_masks_of_another_grid_are_refused() -> None:
    with pytest.raises(SurfaceError, match="does not fit the grid"):
        surface_from_mask(np.ones((3, 3, 3), bool), GRID)
    with pytest.raises(SurfaceError, match="does not fit the grid"):
        surface_from_velocity(np.ones((3, 4, 4, 4)), GRID)
