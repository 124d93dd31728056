"""Wall motion: key frames, order in time, and volume rates against differences and swept flux."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from geometry import Recording, Surface, WallMotion, ellipse, ellipsoid

SPHERE = ellipsoid((1.0, 1.2, 0.8), 0.3)


def _wave(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and velocities of a body that grows, shears and moves, period 1."""
    t = np.asarray(t, float)[..., None, None]
    base = SPHERE.vertices
    angle = 2 * np.pi * t
    shear = base[:, [2, 0, 1]]
    vertices = base * (1 + 0.2 * np.sin(angle)) + 0.1 * np.cos(angle) * shear + 0.3 * np.sin(angle)
    rates = 2 * np.pi * (base * 0.2 * np.cos(angle) - 0.1 * np.sin(angle) * shear + 0.3 * np.cos(angle))
    return vertices, rates


def _motion(times: np.ndarray, *, rates: bool = True, period: float = 0.0) -> WallMotion:
    vertices, velocity = _wave(times)
    given = velocity if rates else None
    return WallMotion.through(times, vertices, SPHERE.faces, SPHERE.region, rates=given, period=period)


def _error(motion: WallMotion, times: np.ndarray) -> tuple[float, float]:
    vertices, velocity = _wave(times)
    place = max(np.abs(motion.vertices(t) - v).max() for t, v in zip(times, vertices, strict=True))
    speed = max(np.abs(motion.velocity(t) - u).max() for t, u in zip(times, velocity, strict=True))
    return place, speed


@pytest.mark.parametrize(("rates", "order"), [(True, (4, 3)), (False, (3, 2))], ids=["given", "differenced"])
def test_order_of_accuracy_in_time(rates: bool, order: tuple[int, int]) -> None:
    asked = np.linspace(0.013, 0.987, 41)
    errors = np.array([_error(_motion(np.linspace(0, 1, n + 1), rates=rates), asked) for n in (10, 20, 40)])
    slopes = np.log2(errors[:-1] / errors[1:])
    assert (slopes[-1] > np.array(order) - 0.35).all()


def test_key_frames_are_met_and_uneven_steps_allowed() -> None:
    times = np.array([0.0, 0.001, 0.051, 0.052, 0.102, 0.2])
    motion = _motion(times)
    for frame, t in enumerate(times):
        np.testing.assert_allclose(motion.vertices(t), motion.vertices_at_keys[frame], atol=1e-14)
        np.testing.assert_allclose(motion.velocity(t), motion.rates_at_keys[frame], atol=1e-12)
    # Differences on uneven steps reproduce parabolas exactly.
    parabola = times[:, None, None] ** 2 * SPHERE.vertices
    motion = WallMotion.through(times, parabola, SPHERE.faces, SPHERE.region)
    np.testing.assert_allclose(motion.vertices(0.03), 0.03**2 * SPHERE.vertices, atol=1e-15)
    np.testing.assert_allclose(motion.velocity(0.03), 0.06 * SPHERE.vertices, atol=1e-13)


@pytest.mark.parametrize("rates", [True, False])
def test_volume_rate_is_the_derivative_of_the_volume(rates: bool) -> None:
    motion = _motion(np.linspace(0, 1, 9), rates=rates)
    for t in (0.07, 0.3, 0.62, 0.9):
        step = 1e-4
        near = [motion.volume(t + k * step) for k in (-2, -1, 1, 2)]
        derivative = (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * step)
        assert motion.volume_rate(t) == pytest.approx(derivative, rel=1e-8)


def test_volume_rate_is_the_flux_swept_by_the_wall_region_by_region() -> None:
    region = (SPHERE.centroids[:, 2] > 0.3).astype(np.uint8)
    vertices, rates = _wave(np.linspace(0, 1, 5))
    motion = WallMotion.through(np.linspace(0, 1, 5), vertices, SPHERE.faces, region, rates=rates)
    total = motion.volume_rate(0.4)
    assert motion.volume_rate(0.4, 0) + motion.volume_rate(0.4, 1) == pytest.approx(total, rel=1e-12)
    # Against midpoint quadrature of u . n with many points on each face.
    surface, velocity = motion.surface(0.4), motion.velocity(0.4)
    corner, speed = surface.vertices[surface.faces], velocity[surface.faces]
    weights = np.random.default_rng(0).dirichlet(np.ones(3), 4000)
    weights = np.concatenate([weights, 2 / 3 - weights])  # mirrored at the centroid: exact for linear functions
    flux = np.einsum("sk,fkd->fsd", weights, speed).mean(1)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    assert (flux * normal).sum() == pytest.approx(total, rel=1e-10)


def test_the_area_of_a_plane_outline_changes_with_the_flux_through_it() -> None:
    outline, times = ellipse((1.0, 2.0), 0.1), np.linspace(0, 1, 4)
    motion = WallMotion.through(times, outline.vertices * (1 + times[:, None, None]), outline.faces, outline.region)
    assert motion.volume(0.5) == pytest.approx(outline.volume * 2.25, rel=1e-12)
    assert motion.volume_rate(0.5) == pytest.approx(outline.volume * 3.0, rel=1e-12)


def test_a_period_wraps_and_closes() -> None:
    times = np.linspace(0, 1, 11)
    motion = _motion(times, rates=False, period=1.0)
    np.testing.assert_allclose(motion.vertices(0.3), motion.vertices(7.3), atol=1e-12)
    np.testing.assert_allclose(motion.velocity(-1e-9), motion.velocity(1e-9), atol=1e-6)
    with pytest.raises(ValueError, match="over the whole period"):
        _motion(times[:-2], period=1.0)


def _recording(box_recording: Callable[..., Recording], times: tuple[float, ...], period: float) -> Recording:
    return box_recording(lambda p, t: 0 * p, times=times, period=period, wall_velocity=lambda p: 0 * p)


@pytest.mark.parametrize(("times", "keys"), [((0.0, 0.1, 0.2), 4), ((0.0, 0.1, 0.2, 0.3), 4), ((0.0, 0.2, 0.4), 3)])
def test_a_recordings_period_is_closed(box_recording: Callable, times: tuple, keys: int) -> None:
    motion = WallMotion.from_recording(_recording(box_recording, times, 0.3))
    assert len(motion.time) == keys
    if times[-1] <= 0.3:
        assert motion.volume(0.29) == pytest.approx(1e-6) and motion.volume(3.29) == pytest.approx(1e-6)


def test_of_several_recorded_beats_each_keeps_its_own_motion(box_recording: Callable) -> None:
    recording = _recording(box_recording, (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6), 0.3)
    grown = recording.wall.vertices * (1 + recording.time[:, None, None])
    motion = WallMotion.through(recording.time, grown, recording.wall.faces, recording.wall.region, period=0.3)
    for t, same in ((0.15, 0.15), (0.45, 0.45), (0.75, 0.45), (-0.2, 0.1), (1.05, 0.45)):
        np.testing.assert_allclose(motion.vertices(t), motion.vertices(same), atol=1e-15)
    assert motion.volume(0.45) > 1.5 * motion.volume(0.15)
    assert motion.velocity(0.6).max() == pytest.approx(0.01, rel=1e-9)


def test_a_last_frame_just_before_the_period_ends_is_replaced(box_recording: Callable) -> None:
    motion = WallMotion.from_recording(_recording(box_recording, (0.0, 0.1, 0.2, 0.2999), 0.3))
    np.testing.assert_allclose(motion.time, [0.0, 0.1, 0.2, 0.3])


def test_a_recording_without_wall_velocity_is_differenced(box_recording: Callable) -> None:
    drift = np.array([0.1, 0.0, -0.2])
    recording = box_recording(lambda p, t: 0 * p, wall_velocity=lambda p: drift + 0 * p)
    without = recording.select(slice(None))
    object.__setattr__(without.wall, "velocity", None)
    for one in (recording, without):
        motion = WallMotion.from_recording(one)
        np.testing.assert_allclose(motion.velocity(0.013), np.broadcast_to(drift, (8, 3)), atol=1e-8)
        assert motion.volume_rate(0.013) == pytest.approx(0.0, abs=1e-12)


def test_times_outside_the_key_frames_are_refused() -> None:
    motion = _motion(np.linspace(0, 1, 5))
    np.testing.assert_allclose(motion.vertices(1 + 1e-9), motion.vertices(1.0))
    for t in (-0.1, 1.1):
        with pytest.raises(ValueError, match="known from 0 to 1 s"):
            motion.vertices(t)
    with pytest.raises(ValueError, match="WallMotion.volume: t must be finite, got nan"):
        motion.volume(np.nan)


def test_malformed_motions_are_refused() -> None:
    vertices, rates = _wave(np.linspace(0, 1, 3))
    with pytest.raises(ValueError, match="increase strictly"):
        WallMotion(np.array([0.0, 0.0, 1.0]), vertices, rates, SPHERE.faces, SPHERE.region)
    with pytest.raises(ValueError, match=r"rates_at_keys must be \(3, nv, D\)"):
        WallMotion(np.linspace(0, 1, 3), vertices, rates[:2], SPHERE.faces, SPHERE.region)


def test_a_wall_at_rest_never_moves() -> None:
    motion = WallMotion.at_rest(SPHERE)
    assert motion.volume_rate(3.0) == 0 and motion.volume(-1.0) == pytest.approx(SPHERE.volume)
    assert isinstance(motion.surface(0.0), Surface) and not motion.moves
