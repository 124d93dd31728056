"""Each measure against a value worked out by hand, on boxes with uniform or linear flow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchsph.evaluation import metrics

UNIFORM = np.array([0.3, -0.2, 0.1])


def uniform(*components):
    return lambda points, _: np.broadcast_to(np.array(components), points.shape)


def swirl(points, time):
    """A flow that no symmetry makes special: shear in space, growth in time."""
    x, y, z = (points / 0.01).T
    return (1 + 20 * time) * np.stack([0.2 + y * z, x - 0.5 * z, 0.1 - x * y], axis=1)


def with_field(recording, velocity):
    return replace(recording, velocity=np.asarray(velocity, np.float32))


@pytest.mark.parametrize(
    ("factor", "nrmse", "magnitude", "angle"), [(1, 0, 0, 0), (0, 1, 1, 90), (2, 1, 1, 0), (-1, 2, 0, 180)]
)
def test_scaled_truth(box_recording, factor, nrmse, magnitude, angle):
    truth = box_recording(swirl)
    scores = metrics.evaluate(with_field(truth, factor * truth.velocity), truth)
    assert scores["nrmse"].value == pytest.approx(nrmse, abs=1e-6)
    assert scores["magnitude_nrmse"].value == pytest.approx(magnitude, abs=1e-6)
    assert scores["direction_error_deg"].value == pytest.approx(angle, abs=1e-4)
    speed = np.linalg.norm(truth.velocity, axis=1)[truth.mask]
    assert scores["vnrmse"].value == pytest.approx(nrmse * np.sqrt(np.mean(speed**2)) / speed.max(), abs=1e-6)


def test_direction_is_the_angle_of_a_rotation(box_recording):
    truth, angle = box_recording(uniform(0.3, 0.0, 0.0)), np.radians(25.0)
    turned = box_recording(uniform(0.3 * np.cos(angle), 0.3 * np.sin(angle), 0.0))
    assert metrics.evaluate(turned, truth)["direction_error_deg"].value == pytest.approx(25.0, abs=1e-4)


def test_direction_looks_at_fast_nodes_alone(box_recording):
    truth = box_recording(lambda p, _: np.where(p[:, :1] > 0.005, [[1.0, 0, 0]], [[0.05, 0, 0]]))
    wrong = with_field(truth, np.where(truth.velocity[:, :1] > 0.5, truth.velocity, -truth.velocity))
    assert metrics.evaluate(wrong, truth)["direction_error_deg"].value == pytest.approx(0.0, abs=1e-6)


def test_pooled_value_is_the_mean_square_of_the_frames(box_recording):
    truth = box_recording(swirl)
    noise = np.random.default_rng(1).normal(0, 0.1, truth.velocity.shape) * truth.mask[:, None]
    scores = metrics.evaluate(with_field(truth, truth.velocity + noise), truth, truth)
    for name in ("nrmse", "vnrmse", "magnitude_nrmse", "divergence_rms", "residual_rms"):
        frames = np.array(scores[name].per_frame)  # the box has as many nodes in every frame
        assert scores[name].value == pytest.approx(np.sqrt(np.mean(frames**2)), rel=1e-6)


def test_nodes_without_a_value_count_as_rest(box_recording):
    truth = box_recording(uniform(*UNIFORM))
    weight = np.ones(truth.mask.shape, np.float32)
    velocity = truth.velocity.copy()
    left = np.broadcast_to(np.arange(truth.grid.shape[2]) < truth.grid.shape[2] // 2, truth.mask.shape)
    weight[left] = 0  # half of the blood: the velocity there may be anything, here not a number
    velocity[np.broadcast_to(left[:, None], velocity.shape)] = np.nan
    holes = metrics.evaluate(replace(truth, velocity=velocity, weight=weight), truth)
    assert holes["nrmse"].value == pytest.approx(np.sqrt(0.5), rel=1e-6)
    assert holes["direction_error_deg"].value == pytest.approx(45.0, rel=1e-6)
    smaller = replace(truth, mask=truth.mask & ~left)
    assert metrics.evaluate(smaller, truth)["nrmse"].value == pytest.approx(np.sqrt(0.5), rel=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_divergence_of_a_linear_field_is_exact(box_recording, dimension):
    gradient = np.array([[3.0, 5.0, -1.0], [2.0, -7.0, 4.0], [0.5, 6.0, 11.0]])[:dimension, :dimension]
    recording = box_recording(lambda points, _: points @ gradient.T, dimension=dimension)
    scores = metrics.evaluate(recording)
    assert scores["divergence_rms"].value == pytest.approx(abs(np.trace(gradient)), rel=1e-4)


def test_divergence_of_a_wave_matches_its_finite_difference(box_recording):
    # div (sin kx, 0, 0) = k cos kx, and central differences turn k into sin(k dx) / dx exactly.
    k, step = 2 * np.pi / 0.01, 0.01 / 16
    wave = box_recording(lambda p, _: np.stack([np.sin(k * p[:, 0]), 0 * p[:, 0], 0 * p[:, 0]], 1), nodes=16)
    x = (np.arange(1, 15) + 0.5) * step  # the interior nodes
    expected = np.sin(k * step) / step * np.sqrt(np.mean(np.cos(k * x) ** 2))
    assert metrics.evaluate(wave)["divergence_rms"].value == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("dimension", "wall_sides"), [(2, 3), (3, 5)])
def test_flow_through_resting_walls(box_recording, dimension, wall_sides):
    # Along x it crosses two of the sides that are wall (the last side is the orifice).
    recording = box_recording(_along_x(0.2), dimension=dimension)
    scores = metrics.evaluate(recording)
    assert scores["wall_normal_rms"].value == pytest.approx(0.2 * np.sqrt(2 / wall_sides), rel=1e-5)


def _along_x(speed):
    return lambda points, _: np.eye(points.shape[1])[0] * speed + 0 * points


def _along_last(speed):
    return lambda points, _: np.eye(points.shape[1])[-1] * speed + 0 * points


@pytest.mark.parametrize("dimension", [2, 3])
def test_wall_that_moves_with_the_flow_lets_nothing_through(box_recording, dimension):
    recording = box_recording(_along_x(0.05), dimension=dimension, wall_velocity=lambda v: _along_x(0.05)(v, 0.0))
    assert metrics.evaluate(recording)["wall_normal_rms"].value == pytest.approx(0.0, abs=1e-7)


def _sinking_floor(vertices):
    """The floor sinks at 20 mm/s, the orifice on top stays: the volume grows by 0.02 L^(D-1) m3/s."""
    return np.where(vertices[:, -1:] == 0, -0.02, 0.0) * np.eye(vertices.shape[1])[-1]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("speed", "expected"), [(-0.02, 0.0), (0.0, 1.0), (-0.03, 0.5), (0.02, 2.0)])
def test_flow_rate_against_the_growth_of_the_volume(box_recording, dimension, speed, expected):
    recording = box_recording(_along_last(speed), dimension=dimension, wall_velocity=_sinking_floor)
    assert metrics.evaluate(recording)["flow_rate_error"].value == pytest.approx(expected, abs=1e-5)


def test_flow_rate_prefers_the_fluxes_of_the_truth(box_recording):
    inflow = np.array([1e-6, 2e-6, 3e-6])
    truth = box_recording(_along_last(0.0), flux_mitral=1.5 * inflow, flux_aortic=-0.5 * inflow)
    recording = box_recording(lambda p, t: _along_last(-(1 + 100 * t) * 0.01)(p, t))  # 0.01 m/s through (10 mm)^2
    scores = metrics.evaluate(recording, truth)
    assert scores["flow_rate_error"].value == pytest.approx(0.0, abs=1e-5)


def test_flow_rate_of_a_closed_still_box_is_undefined(box_recording):
    assert metrics.evaluate(box_recording(_along_last(0.1)))["flow_rate_error"].value is None


def test_residual_weighs_and_skips_what_was_not_measured(box_recording):
    measured = box_recording(uniform(0.0, 0.0, 0.0))
    weight = np.ones(measured.mask.shape, np.float32)
    weight[..., ::2] = 0.25
    speed = np.where(weight == 1, 0.1, 0.3)
    analysis = with_field(measured, np.stack([speed * measured.mask, 0 * speed, 0 * speed], 1))
    w, s = weight[measured.mask], speed[measured.mask]
    scores = metrics.evaluate(analysis, None, replace(measured, weight=weight))
    assert scores["residual_rms"].value == pytest.approx(np.sqrt(np.sum(w * s**2) / np.sum(w)), rel=1e-5)


def test_residual_to_a_doppler_measurement_is_along_its_beam(box_recording):
    beam = np.zeros((3, 10, 10, 10), np.float32)
    beam[2] = 1
    measured = replace(box_recording(uniform(0.0, 0.0, 0.3)), beam=beam)
    assert metrics.evaluate(box_recording(uniform(5.0, -4.0, 0.3)), None, measured)["residual_rms"].value == (
        pytest.approx(0.0, abs=1e-7)
    )


def test_without_a_truth_only_what_needs_none(box_recording):
    recording = box_recording(swirl)
    assert set(metrics.evaluate(recording)) == {"divergence_rms", "wall_normal_rms", "flow_rate_error"}
    assert set(metrics.evaluate(recording, recording, recording)) == set(metrics.METRICS)


def test_truth_with_more_frames_is_matched_by_time(box_recording):
    truth = box_recording(swirl, times=(0.0, 0.005, 0.01, 0.015, 0.02))
    analysis = box_recording(swirl, times=(0.005, 0.015))
    assert metrics.evaluate(analysis, truth)["nrmse"].value == pytest.approx(0.0, abs=1e-6)


def test_truth_that_does_not_fit_is_refused(box_recording):
    analysis = box_recording(swirl, times=(0.0, 0.007))
    with pytest.raises(ValueError, match=r"no frame at 0\.007 s \(1 of 2"):
        metrics.evaluate(analysis, box_recording(swirl))
    with pytest.raises(ValueError, match="another grid"):
        metrics.evaluate(analysis, box_recording(swirl, nodes=9, times=(0.0, 0.007)))


def test_truth_at_rest_has_no_relative_error(box_recording):
    still = box_recording(uniform(0.0, 0.0, 0.0))
    scores = metrics.evaluate(box_recording(swirl), still)
    assert scores["nrmse"].value is None and scores["direction_error_deg"].value is None
    assert scores["nrmse"].per_frame == [None] * 3
