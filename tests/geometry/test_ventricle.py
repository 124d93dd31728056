"""The parametric ventricle: closed forms against quadrature, differences and its own meshes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from geometry import (
    Beat,
    Grid,
    SurfaceError,
    SurfaceIndex,
    Ventricle,
    WallMotion,
    read_recording,
    winding_number,
    write_recording,
)

SHAPES = [Ventricle(), Ventricle(length=0.06, semi_major=0.05, semi_minor=0.02, aortic_centre=(0.01, 0.0))]


@pytest.mark.parametrize("shape", SHAPES)
def test_volume_equals_quadrature(shape: Ventricle) -> None:
    def section(z: float) -> float:
        return np.pi * shape.semi_minor**2 * (1 - ((z + shape.offset) / shape.semi_major) ** 2)

    assert shape.end_diastolic_volume == pytest.approx(quad(section, -shape.length, 0)[0], rel=1e-12)
    assert section(0.0) == pytest.approx(np.pi * shape.base_radius**2)


def test_rate_is_the_derivative_of_the_volume_and_the_beat_closes() -> None:
    shape = Ventricle()
    for t in np.linspace(0.005, 0.44, 30):
        step = 1e-5
        difference = (shape.volume(t + step) - shape.volume(t - step)) / (2 * step)
        assert shape.volume_rate(t) == pytest.approx(difference, rel=1e-5, abs=1e-12)
        rates = (shape.scales(t + step) - shape.scales(t - step)) / (2 * step)
        np.testing.assert_allclose(shape.scale_rates(t), rates, rtol=1e-5, atol=1e-7)
    assert shape.volume(shape.beat.period) == pytest.approx(shape.volume(0.0))
    lowest = shape.volume(shape.beat.ejection[1]) / shape.volume(0)
    assert lowest == pytest.approx(1 - shape.beat.stroke_fraction)
    filled = quad(shape.volume_rate, *shape.beat.filling, limit=200)[0]
    assert filled == pytest.approx(shape.beat.stroke_fraction * shape.volume(0), rel=1e-6)


def test_mesh_volume_and_orifice_areas_converge() -> None:
    shape = Ventricle()
    mitral = np.pi * shape.mitral_semi_axes[0] * shape.mitral_semi_axes[1]
    aortic = np.pi * shape.aortic_radius**2
    errors = []
    for spacing in (2e-3, 1e-3, 0.5e-3):
        surface = shape.surface(spacing)
        surface.check()
        areas = [surface.areas[surface.part(region)].sum() for region in (1, 2)]
        errors.append([surface.volume / shape.volume(0) - 1, areas[0] / mitral - 1, areas[1] / aortic - 1])
    errors = np.abs(errors)
    assert (errors[-1] < 5e-3).all() and (errors[-1] < errors[0]).all()
    assert 3.4 < errors[1, 0] / errors[2, 0] < 4.6
    flat = surface.normals[surface.region > 0]
    np.testing.assert_allclose(flat, np.broadcast_to([0, 0, 1], flat.shape), atol=1e-12)


def test_the_moving_mesh_has_the_exact_volume_of_an_affine_motion() -> None:
    shape = Ventricle()
    recording = shape.recording(np.linspace(0, 0.44, 45), grid_spacing=2e-3)
    motion = WallMotion.from_recording(recording)
    for frame in (0, 7, 30):
        t = recording.time[frame]
        ratio = recording.wall.at(0).volume / shape.volume(0)
        assert motion.volume(t) == pytest.approx(ratio * shape.volume(t), rel=1e-10)
        assert motion.volume_rate(t) == pytest.approx(ratio * shape.volume_rate(t), rel=1e-5, abs=1e-11)
        assert motion.volume_rate(t, 1) == pytest.approx(0, abs=1e-15)  # the base stays in its plane
    np.testing.assert_allclose(
        recording.flux_mitral + recording.flux_aortic, [shape.volume_rate(t) for t in recording.time]
    )


def test_contains_agrees_with_the_mesh_and_the_mask() -> None:
    shape = Ventricle()
    recording = shape.recording([0.0, 0.1], grid_spacing=2e-3, wall_spacing=0.4e-3)
    volume = recording.mask.sum(axis=(1, 2, 3)) * recording.grid.cell_volume
    np.testing.assert_allclose(volume, recording.volume, rtol=0.1)
    surface = shape.surface(0.8e-3, 0.1)
    points = np.random.default_rng(0).uniform(-0.01, 0.002, (150, 3)) * np.array([1, 1, 3])
    clear = SurfaceIndex(surface).query(points).distance > 5e-5
    inside = winding_number(surface.vertices, surface.faces, points[clear]) > 0.5
    np.testing.assert_array_equal(inside, shape.contains(points[clear], 0.1))


def test_recording_carries_the_velocity_given_and_survives_the_file(tmp_path) -> None:
    shape = Ventricle(beat=Beat(period=0.5, ejection=(0.05, 0.25), early=(0.3, 0.4), late=(0.4, 0.5)))
    recording = shape.recording(
        np.arange(0, 0.5, 0.05),
        grid_spacing=2e-3,
        wall_spacing=2e-3,
        velocity=shape.wall_velocity,
        periodic=True,
    )
    nodes = recording.grid.nodes().numpy()
    expected = shape.wall_velocity(nodes, recording.time[3])
    found = recording.velocity[3].reshape(3, -1).T
    mask = recording.mask[3].ravel()
    np.testing.assert_allclose(found[mask], expected[mask], rtol=1e-5, atol=1e-9)
    assert (found[~mask] == 0).all() and isinstance(recording.grid, Grid)
    assert recording.valve_open[:, 1].tolist() == [0, 1, 1, 1, 1, 0, 0, 0, 0, 0]
    np.testing.assert_array_equal(recording.valve_intervals, [[1, 0.3, 0.5], [2, 0.05, 0.25]])
    write_recording(tmp_path / "v.h5", recording)
    assert read_recording(tmp_path / "v.h5").period == 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mitral_centre": (-0.007, 0.0)}, "mitral orifice reaches beyond the base"),
        ({"aortic_centre": (0.001, 0.0)}, "orifice meet"),
        ({"aortic_centre": (-0.0041, 0.0), "aortic_radius": 0.001}, "orifice meet"),
        (
            {"mitral_centre": (0.0, 0.0), "mitral_semi_axes": (0.0005, 0.0005), "aortic_centre": (0, 0)},
            "meet",
        ),
        ({"length": 0.05}, "semi_major <= length"),
    ],
)
def test_impossible_ventricles_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Ventricle(**options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stroke_fraction": 1.0}, "stroke_fraction"),
        ({"late_share": -0.1}, "late_share"),
        ({"early": (0.4, 0.3)}, "early must be"),
        ({"ejection": (0.03, 0.3)}, "after ejection"),
    ],
)
def test_impossible_beats_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Beat(**options)


def test_a_mesh_that_cannot_keep_the_rims_is_refused() -> None:
    with pytest.raises(SurfaceError, match="below half the base radius"):
        Ventricle().surface(6e-3)
    for spacing in (3e-3, 1.7e-3, 0.77e-3):
        Ventricle().surface(spacing).check()
