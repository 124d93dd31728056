"""Orifices and wall points: areas, normals, rims and velocities of shapes whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from geometry import (
    Surface,
    SurfaceError,
    Ventricle,
    WallMotion,
    WallSampler,
    box,
    ellipsoid,
    orifices,
    polygon,
    refined,
    tube,
    wall_points,
)

SHAPE = Ventricle()
MOTION = WallMotion.from_recording(SHAPE.recording(np.linspace(0, 0.44, 45), grid_spacing=3e-3, wall_spacing=0.6e-3))


def _turned(motion: WallMotion, angle: float, shift: np.ndarray) -> WallMotion:
    """The same motion in a frame that turns by `angle` (rad) around y in its course and moves by `shift`."""
    ends = motion.time[[0, -1]]
    part = (motion.time - ends[0]) / (ends[1] - ends[0])
    turned = []
    for share, vertices in zip(part, motion.vertices_at_keys, strict=True):
        c, s = np.cos(share * angle), np.sin(share * angle)
        turned.append(vertices @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + share * shift)
    return WallMotion.through(motion.time, np.stack(turned), motion.faces, motion.region)


def test_the_ventricles_orifices_follow_its_scale() -> None:
    mitral, aortic = orifices(MOTION)
    assert (mitral.label, aortic.label) == (1, 2)
    for t in (0.0, 0.15, 0.3):
        scale = SHAPE.scales(t)[0]
        np.testing.assert_allclose(mitral.centroid(t), [SHAPE.mitral_centre[0] * scale, 0, 0], atol=5e-5)
        np.testing.assert_allclose(aortic.normal(t), [0, 0, 1], atol=1e-12)
        expected = np.pi * SHAPE.mitral_semi_axes[0] * SHAPE.mitral_semi_axes[1] * scale**2
        assert mitral.area(t) == pytest.approx(expected, rel=0.01)
        speed = SHAPE.scale_rates(t)[0] * SHAPE.aortic_centre[0]
        np.testing.assert_allclose(aortic.velocity(t), [speed, 0, 0], atol=2e-4)
        rim = aortic.rim(t)
        away = np.linalg.norm(rim[:, :2] - np.array(SHAPE.aortic_centre) * scale, axis=1)
        np.testing.assert_allclose(away, SHAPE.aortic_radius * scale, rtol=1e-5)
        angle = np.unwrap(np.arctan2(*(rim - aortic.centroid(t)).T[[1, 0]]))
        assert (np.diff(angle) > 0).all()  # in order, counter-clockwise seen from outside


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lateral_distance_and_height_of_a_circle(dtype: torch.dtype) -> None:
    aortic = orifices(MOTION)[1]
    t, scale = 0.15, SHAPE.scales(0.15)[0]
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=dtype) * 0.02 - 0.01
    away = np.linalg.norm(points.numpy()[:, :2] - np.array(SHAPE.aortic_centre) * scale, axis=1)
    distance = aortic.lateral_distance(points, t)
    assert distance.dtype == dtype
    sagitta = 0.6e-3**2 / 8 / SHAPE.aortic_radius
    np.testing.assert_allclose(distance, SHAPE.aortic_radius * scale - away, atol=2 * sagitta)
    np.testing.assert_allclose(aortic.height(points, t), points[:, 2], atol=1e-8)


def test_orifices_turn_and_move_with_the_wall() -> None:
    turned = orifices(_turned(MOTION, 0.5, np.array([0.01, 0.0, 0.02])))[0]
    plain, end = orifices(MOTION)[0], float(MOTION.time[-1])
    np.testing.assert_allclose(turned.normal(end), [np.sin(0.5), 0, np.cos(0.5)], atol=1e-9)
    assert turned.area(end) == pytest.approx(plain.area(end), rel=1e-9)
    local = torch.rand(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.01 - 0.005
    c, s = np.cos(0.5), np.sin(0.5)
    matrix = torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]], dtype=torch.float64)
    moved = local @ matrix + torch.tensor([0.01, 0.0, 0.02], dtype=torch.float64)
    torch.testing.assert_close(turned.lateral_distance(moved, end), plain.lateral_distance(local, end))
    torch.testing.assert_close(turned.height(moved, end), plain.height(local, end))
    # The directions in the opening travel with it, as a stored profile must.
    torch.testing.assert_close(turned.at(end).lateral(moved), plain.at(end).lateral(local))


def test_a_bulging_lid_has_the_opening_of_a_flat_one() -> None:
    pipe = tube(1.0, 2.0, 0.1)
    bulge = pipe.vertices.copy()
    top = np.isclose(bulge[:, 2], 2.0)
    bulge[top, 2] += 0.3 * (1 - (bulge[top, :2] ** 2).sum(1))
    flat, round_ = (orifices(WallMotion.at_rest(pipe.moved(v)))[1] for v in (pipe.vertices, bulge))
    assert round_.area(0.0) == pytest.approx(flat.area(0.0), rel=1e-9)
    np.testing.assert_allclose(round_.normal(0.0), flat.normal(0.0), atol=1e-9)


def test_a_region_in_two_pieces_makes_two_orifices() -> None:
    pipe = tube(1.0, 2.0, 0.2)
    same = Surface(pipe.vertices, pipe.faces, np.minimum(pipe.region, 1))
    found = orifices(WallMotion.at_rest(same))
    assert [o.label for o in found] == [1, 1]
    assert sorted(float(o.normal(0.0)[2]) for o in found) == pytest.approx([-1, 1])


def test_an_annular_opening_leaves_its_middle_out() -> None:
    pipe = tube(1.0, 2.0, 0.1)
    radius = np.linalg.norm(pipe.centroids[:, :2], axis=1)
    ring = np.where((pipe.region == 2) & (radius > 0.5), 2, 0)
    opening = orifices(WallMotion.at_rest(Surface(pipe.vertices, pipe.faces, ring)))[0]
    points = torch.tensor([[0.0, 0.0, 2.0], [0.75, 0.0, 2.0], [1.5, 0.0, 2.0]], dtype=torch.float64)
    np.testing.assert_allclose(opening.lateral_distance(points, 0.0), [-0.5, 0.25, -0.5], atol=0.02)
    assert opening.area(0.0) == pytest.approx(np.pi * 0.75, rel=0.02)


def test_plane_openings_are_intervals() -> None:
    square = polygon(np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]]), 0.25)
    top = (square.centroids[:, 1] > 0.99) & (np.abs(square.centroids[:, 0] - 1) < 0.5)
    opening = orifices(WallMotion.at_rest(Surface(square.vertices, square.faces, top)))[0]
    np.testing.assert_allclose(opening.normal(0.0), [0, 1], atol=1e-12)
    assert opening.area(0.0) == pytest.approx(1.0)
    points = torch.tensor([[1.0, 5.0], [0.6, 0.0], [0.0, 1.0]], dtype=torch.float64)
    np.testing.assert_allclose(opening.lateral_distance(points, 0.0), [0.5, 0.1, -0.5], atol=1e-12)
    np.testing.assert_allclose(opening.height(points, 0.0), [4.0, -1.0, 0.0], atol=1e-12)


def test_regions_that_are_no_openings_are_refused() -> None:
    ball = ellipsoid((1.0, 1.0, 1.0), 0.4)
    closed = Surface(ball.vertices, ball.faces, np.ones(len(ball.faces)))
    with pytest.raises(SurfaceError, match="/wall/region: region 1 has no rim"):
        orifices(WallMotion.at_rest(closed))
    assert orifices(WallMotion.at_rest(ball)) == []


@pytest.mark.parametrize("spacing", [3e-3, 1e-3, 0.3e-3])
def test_wall_points_share_out_the_area_and_sweep_the_volume(spacing: float) -> None:
    sampler = WallSampler(MOTION, spacing, smooth_angle=0)
    for t in (0.1, 0.3):
        wall = sampler.at(t)
        assert wall.areas.sum() == pytest.approx(MOTION.surface(t).area, rel=1e-12)
        flux = (wall.areas * (wall.normals * wall.velocities).sum(1)).sum()
        assert flux == pytest.approx(MOTION.volume_rate(t), rel=1e-9 if spacing < 4e-4 else 3e-3)
        np.testing.assert_allclose(np.linalg.norm(wall.normals, axis=1), 1, atol=1e-12)
        surface = MOTION.surface(t)
        for label in (0, 1, 2):
            share = wall.areas[wall.region == label].sum()
            assert share == pytest.approx(surface.areas[surface.part(label)].sum(), rel=1e-9)


def test_flat_sides_carry_points_at_the_spacing_wherever_they_are() -> None:
    from scipy.spatial import cKDTree

    coarse = box((0, 0, 0), (1, 1, 1), 1.0)  # two triangles a side, as qhull leaves it
    wall = wall_points(WallMotion.at_rest(coarse), 0.0, 0.1)
    anywhere = np.random.default_rng(0).random((2000, 3))
    side = np.random.default_rng(1).integers(0, 3, 2000)
    anywhere[np.arange(2000), side] = np.round(anywhere[np.arange(2000), side])
    assert cKDTree(wall.points).query(anywhere)[0].max() < 0.1
    assert 0.5 < len(wall.points) * 0.1**2 / 6 < 2
    np.testing.assert_allclose(np.abs(wall.normals).max(axis=1), 1, atol=1e-12)  # the edges stay sharp


def test_a_mesh_much_finer_than_the_spacing_is_thinned() -> None:
    fine = ellipsoid((1.0, 1.0, 1.0), 0.03)
    wall = wall_points(WallMotion.at_rest(fine), 0.0, 0.3)
    assert len(wall.points) < 0.1 * len(fine.faces) and wall.areas.max() < 2 * 0.3**2
    np.testing.assert_allclose(np.linalg.norm(wall.points, axis=1), 1, atol=0.02)
    assert (wall.normals * wall.points).sum(axis=1).min() > 0.98


def test_smooth_normals_follow_the_curve_of_a_coarse_mesh() -> None:
    coarse = ellipsoid((1.0, 1.0, 1.0), 0.4)
    tilt = []
    for angle in (0.0, 30.0):
        wall = wall_points(WallMotion.at_rest(coarse), 0.0, 0.1, smooth_angle=angle)
        radial = wall.points / np.linalg.norm(wall.points, axis=1, keepdims=True)
        tilt.append(np.degrees(np.arccos(np.clip((wall.normals * radial).sum(1), -1, 1))).max())
    assert tilt[1] < 0.45 * tilt[0]


def test_points_of_a_plane_outline() -> None:
    motion = WallMotion.through(
        np.array([0.0, 1.0]),
        np.stack([(1 + k) * polygon(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), 0.5).vertices for k in (0, 1)]),
        polygon(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), 0.5).faces,
        np.zeros(8, np.uint8),
    )
    wall = wall_points(motion, 0.5, 0.1, smooth_angle=0)
    assert wall.areas.sum() == pytest.approx(6.0)
    assert (wall.areas * (wall.normals * wall.velocities).sum(1)).sum() == pytest.approx(motion.volume_rate(0.5))


def test_wall_points_refuse_nonsense() -> None:
    for options in ({"spacing": 0.0}, {"spacing": 1.0, "smooth_angle": 90.0}):
        with pytest.raises(
            ValueError,
            match="WallSampler: (spacing must be from 1e-100|smooth_angle must be 0 or more and less than 90)",
        ):
            WallSampler(MOTION, **options)


def test_faces_without_area_leave_no_points_without_a_place() -> None:
    cube = box((0, 0, 0), (1, 1, 1), 1.0)
    a, b, c = cube.faces[0]
    middle, count = cube.vertices[[a, b]].mean(0), len(cube.vertices)
    faces = np.concatenate([cube.faces[1:], [[a, count, c], [count, b, c], [a, b, count]]])  # the last one is a line
    cut = Surface(np.vstack([cube.vertices, middle]), faces, np.zeros(len(faces), int))
    wall = wall_points(WallMotion.at_rest(cut), 0.0, 0.25)
    assert np.isfinite(wall.points).all() and np.isfinite(wall.velocities).all()
    assert np.abs(np.abs(wall.points - 0.5).max(1) - 0.5).max() < 1e-12  # all of them on the cube
    assert wall.areas.sum() == pytest.approx(6.0)


def test_wall_points_of_a_refined_wall_are_those_of_the_wall() -> None:
    cube = box((0, 0, 0), (1, 1, 1), 1.0)
    one, other = (wall_points(WallMotion.at_rest(s), 0.0, 0.25) for s in (cube, refined(cube, 0.05)))
    assert one.areas.sum() == pytest.approx(other.areas.sum(), rel=1e-12)
    assert len(other.points) < 2.5 * len(one.points)
