"""Frames of any size, with many faces, few faces or no walls at all, are smoothed with no option set."""

import numpy as np
import pytest
import torch

import geometry
from regularize import Smoother
from torchsph import smooth
from torchsph.methods.measurement.frame_splines import FrameSmoother
from torchsph.methods.measurement.wall_rows import at_knots, wall_rows


def turning(points, t):
    """A rigid rotation about the middle of the box, m/s: no divergence, no normal velocity on the axis."""
    away = points - 0.5 * points.max(0, keepdims=True)
    out = np.zeros_like(points)
    out[:, 0], out[:, 1] = -away[:, 1], away[:, 0]
    return out / np.abs(out).max()


def without_wall(recording):
    """The same grid, velocity and mask, and nobody knows the wall."""
    names = ("time", "grid", "velocity", "mask", "rho", "mu", "weight")
    return geometry.Recording(wall=None, **{name: getattr(recording, name) for name in names})


def noisy(recording, sigma=0.2):
    drawn = np.random.default_rng(0).normal(0, sigma, recording.velocity.shape) * recording.mask[:, None]
    return recording.with_velocity(recording.velocity + drawn.astype(np.float32))


def error(found, true):
    mask = np.broadcast_to(true.mask[:, None], true.velocity.shape)
    return np.sqrt(((found.velocity - true.velocity)[mask] ** 2).mean() / (true.velocity[mask] ** 2).mean())


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("size", [0.003, 0.012, 0.1])
def test_recordings_without_walls_of_any_size_are_smoothed(box_recording, dimension, size):
    true = without_wall(box_recording(turning, dimension=dimension, size=size, nodes=12, times=(0.0,)))
    measured = noisy(true)
    assert error(smooth(measured), true) < 0.4 * error(measured, true)


def test_a_recording_without_walls_keeps_its_file(box_recording, tmp_path):
    true = without_wall(box_recording(turning))
    geometry.write_recording(tmp_path / "plain.h5", true)
    back = geometry.read_recording(tmp_path / "plain.h5")
    assert back.wall is None and back.select([1]).wall is None
    np.testing.assert_array_equal(back.velocity, true.velocity)


def test_who_needs_walls_says_so_by_name(box_recording):
    plain = without_wall(box_recording(turning))
    with pytest.raises(geometry.RecordingError, match="motion of the wall: /wall: is not in this"):
        geometry.WallMotion.from_recording(plain)


def test_knots_follow_the_grid_of_the_recording(box_recording):
    for size in (0.003, 0.1):
        recording = noisy(box_recording(turning, size=size, nodes=12, times=(0.0,)))
        knots = FrameSmoother(recording, Smoother()).fit(0).knots
        assert knots.spacing == pytest.approx((3 * size / 12,) * 3)


def test_points_on_the_wall_follow_the_knots():
    still = geometry.WallMotion.at_rest
    coarse, fine = geometry.ellipsoid((10e-3,) * 3, 8e-3), geometry.ellipsoid((10e-3,) * 3, 0.3e-3)
    cut, none = at_knots(still(coarse), 3e-3)
    assert none is None and len(cut.faces) > len(coarse.faces)
    assert cut.volume(0.0) == pytest.approx(coarse.volume, rel=1e-12)
    same, sampler = at_knots(still(fine), 3e-3)
    assert same.faces is not None and len(same.faces) == len(fine.faces)
    assert sampler is not None and len(sampler) < 0.3 * len(fine.faces)
    assert sampler.at(0.0).areas.sum() == pytest.approx(fine.area, rel=1e-9)
    assert at_knots(still(geometry.ellipsoid((10e-3,) * 3, 1e-3)), 3e-3)[1] is None


@pytest.mark.parametrize("spacing", [1.2e-3, 0.25e-3])
def test_rows_carry_the_flux_of_the_wall_whatever_its_faces(spacing):
    shape = geometry.Ventricle()
    recording = shape.recording([0.05, 0.1, 0.15], grid_spacing=2e-3, wall_spacing=spacing)
    motion, sampler = at_knots(geometry.WallMotion.from_recording(recording), 4e-3)
    assert (sampler is None) == (spacing > 1e-3)
    rows = wall_rows(recording, motion, 1, sampler=sampler)
    flux = float((rows.weight * (rows.normals * rows.velocity).sum(1)).sum())
    assert flux == pytest.approx(0.0, abs=0.02 * abs(motion.volume_rate(0.1)))
    assert rows.no_slip is not None and torch.isfinite(rows.points).all()
