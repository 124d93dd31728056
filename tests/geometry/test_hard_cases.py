"""Walls as they come: fine, self-touching, fast, unevenly timed, without velocity."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from geometry import (
    Grid,
    MovingDistance,
    Surface,
    Ventricle,
    WallMotion,
    box,
    ellipsoid,
    orifices,
    repaired,
    signed_distance,
    wall_points,
)


def test_a_mesh_of_a_hundred_thousand_faces() -> None:
    axes = np.array([9e-3, 9e-3, 16e-3])
    fine = ellipsoid(axes, 0.25e-3)
    assert len(fine.faces) > 100_000
    fine.check()
    assert repaired(fine).volume == pytest.approx(fine.volume, rel=1e-12)
    grid = Grid.covering(tuple(-axes - 2e-3), tuple(axes + 2e-3), 2e-3)
    distance = signed_distance(grid, fine)
    # In the plane z = 0 the ellipsoid's distance is that of a circle.
    k = int(np.argmin(np.abs(grid.axis(2).numpy())))
    x, y = np.meshgrid(grid.axis(0), grid.axis(1))
    z = float(grid.axis(2)[k])
    assert abs(z) < 1e-9
    np.testing.assert_allclose(distance[k], axes[0] - np.hypot(x, y), atol=3e-5)
    wall = wall_points(WallMotion.at_rest(fine), 0.0, 1e-3)
    assert wall.areas.sum() == pytest.approx(fine.area, rel=1e-9) and len(wall.points) < 6000


def test_self_touching_walls_keep_their_sign() -> None:
    """Two chambers that share an edge of the mesh: four faces meet there, and pseudo-normals cancel."""
    a = box((0, 0, 0), (1, 1, 1), 0.5)
    both = np.concatenate([a.vertices, a.vertices + [1, 1, 0]])
    vertices, place = np.unique(both, axis=0, return_inverse=True)
    touching = Surface(vertices, place.reshape(-1)[np.concatenate([a.faces, a.faces + len(a.vertices)])])
    touching.check()
    grid = Grid.covering((-0.45, -0.45, 0.15), (2.45, 2.45, 0.85), 0.1)
    nodes = grid.nodes().numpy()
    inside = ((nodes[:, :2] > 0) & (nodes[:, :2] < 1)).all(1) | ((nodes[:, :2] > 1) & (nodes[:, :2] < 2)).all(1)
    distance = signed_distance(grid, touching).ravel()
    np.testing.assert_array_equal(distance > 0, inside)
    exact = np.minimum(np.abs(nodes[:, 0] - np.rint(nodes[:, 0])), np.abs(nodes[:, 1] - np.rint(nodes[:, 1])))
    exact = np.minimum(exact, np.minimum(nodes[:, 2], 1 - nodes[:, 2]))
    np.testing.assert_allclose(distance[inside], exact[inside], atol=1e-12)


def test_sheets_that_cross_enclose_their_union() -> None:
    one, other = ellipsoid((1.0, 1.0, 1.0), 0.15), ellipsoid((1.0, 1.0, 1.0), 0.15, (1.0, 0.0, 0.0))
    faces = np.concatenate([one.faces, other.faces + len(one.vertices)])
    crossing = Surface(np.concatenate([one.vertices, other.vertices]), faces)
    grid = Grid.covering((-1.25, -1.25, -1.25), (2.25, 1.25, 1.25), 0.25)
    nodes = grid.nodes().numpy()
    near = np.minimum(np.linalg.norm(nodes, axis=1), np.linalg.norm(nodes - [1, 0, 0], axis=1))
    clear = np.abs(near - 1) > 0.02
    distance = signed_distance(grid, crossing).ravel()
    np.testing.assert_array_equal((distance > 0)[clear], (near < 1)[clear])


def test_an_open_inside_out_mesh_with_seams_becomes_a_wall() -> None:
    shape = Ventricle()
    surface = shape.surface(1.5e-3)
    soup = surface.vertices[surface.faces[:, ::-1]].reshape(-1, 3)
    broken = Surface(soup, np.arange(len(soup)).reshape(-1, 3), surface.region)
    keep = np.arange(len(broken.faces)) % 97 > 0
    mended = repaired(Surface(broken.vertices, broken.faces[keep], broken.region[keep]))
    assert mended.volume == pytest.approx(surface.volume, rel=2e-3)
    assert {1, 2} <= set(np.unique(mended.region))


@pytest.mark.parametrize("step", [1e-3, 50e-3])
@pytest.mark.parametrize("velocity", [True, False], ids=["with velocity", "without"])
def test_key_frames_near_and_far(step: float, velocity: bool) -> None:
    shape = Ventricle()
    time = np.arange(0.0, 0.4, step) if step > 1e-2 else np.arange(0.1, 0.12, step)
    recording = shape.recording(time, grid_spacing=3e-3, wall_spacing=2e-3)
    if not velocity:
        object.__setattr__(recording.wall, "velocity", None)
    motion = WallMotion.from_recording(recording)
    asked = np.linspace(time[0], time[-1], 37)
    ratio = recording.wall.at(0).volume / recording.volume[0]
    error = np.array([motion.volume(t) / (ratio * shape.volume(t)) - 1 for t in asked])
    rates = np.array([motion.volume_rate(t) / ratio - shape.volume_rate(t) for t in asked])
    peak = max(abs(shape.volume_rate(t)) for t in np.linspace(0, 0.44, 200))
    # At 50 ms a whole filling wave lies between few frames: no interpolation can know better than this.
    bound = {1e-3: (1e-6, 1e-3), 50e-3: (0.03, 0.25) if velocity else (0.05, 0.7)}[step]
    assert np.abs(error).max() < bound[0] and np.abs(rates).max() < bound[1] * peak


def test_a_wall_that_outruns_the_grid_between_two_frames() -> None:
    """Frames 50 ms apart, the wall moving several spacings: inside stays inside at every time between."""
    shape = Ventricle()
    spacing = 0.6e-3
    recording = shape.recording([0.08, 0.13], grid_spacing=spacing, wall_spacing=1.5e-3)
    motion = WallMotion.from_recording(recording)
    assert motion.travel(0) > 2.5 * spacing
    moving = MovingDistance(recording.grid.padded(3), motion, band=4 * spacing)
    for t in (0.1, 0.104):
        surface = motion.surface(t)
        on_wall = torch.as_tensor(surface.centroids[::7], dtype=torch.float32)
        wall = moving.at(t).at(on_wall)
        sharp = np.abs(surface.centroids[::7, 2]) < 2 * spacing  # around the rim of the base
        assert np.abs(wall.distance.numpy()[~sharp]).max() < 0.05 * spacing
        assert np.abs(wall.distance.numpy()[sharp]).max() < 0.6 * spacing
        speed = motion.velocity(t)[motion.faces].mean(axis=1)[::7]
        assert np.abs(wall.velocity.numpy()[~sharp] - speed[~sharp]).max() < 0.05 * np.abs(speed).max()


def test_orifices_survive_key_frames_far_apart() -> None:
    shape = Ventricle()
    motion = WallMotion.from_recording(shape.recording([0.0, 0.12, 0.4], grid_spacing=3e-3, wall_spacing=2e-3))
    for t in (0.03, 0.2, 0.37):
        for opening in orifices(motion):
            np.testing.assert_allclose(opening.normal(t), [0, 0, 1], atol=1e-9)
            assert 0.3 < opening.area(t) / opening.area(0.0) < 1.5
