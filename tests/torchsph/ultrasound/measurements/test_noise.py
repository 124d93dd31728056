"""The noise model has the statistics that it states, on a vortex in a box; no phantom is involved."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import spearmanr
from ultrasound_cases import recording, uniform, vortex

import geometry
from torchsph.ultrasound.measurements.noise import NoiseModel, frame_seed, measure_noise

STILL = NoiseModel(outliers=0.0, blur=None, shear=None, clutter=None, dropout=0.0)


def error(measured, true):
    rows = np.searchsorted(true.time, measured.time)
    seen = measured.mask & (measured.weight > 0)
    return (measured.velocity - true.velocity[rows]).transpose(1, 0, 2, 3, 4)[:, seen], measured.weight[seen]


def test_noise_deviation_is_the_one_asked_for_across_and_along_the_beam():
    true = recording(uniform, frames=12)
    off, _ = error(measure_noise(true, STILL, 0), true)
    np.testing.assert_allclose(off.std(axis=1), [0.06, 0.06, 0.025], rtol=0.1)
    off, _ = error(measure_noise(true, dataclasses.replace(STILL, beam_axis=0), 0), true)
    np.testing.assert_allclose(off.std(axis=1), [0.025, 0.06, 0.06], rtol=0.1)


def test_noise_is_correlated_over_three_millimetres():
    true = recording(uniform, frames=12)
    off = (measure_noise(true, STILL, 1).velocity - true.velocity)[:, 0, 1:-1, 1:-1, 1:-1]
    at_lag = [np.corrcoef(off[..., lag:].ravel(), off[..., :-lag].ravel())[0, 1] for lag in (1, 3, 7)]
    expected = [0.25 ** ((lag / 3) ** 2) for lag in (1, 3, 7)]
    np.testing.assert_allclose(at_lag, expected, atol=0.08)


def test_noise_grows_with_shear_and_keeps_its_rms():
    true = recording(vortex, frames=10)
    model = dataclasses.replace(STILL, shear=20.0)
    off, _ = error(measure_noise(true, model, 2), true)
    assert math.sqrt((off[0] ** 2).mean()) == pytest.approx(0.06, rel=0.1)
    gradient = np.gradient(true.velocity[0].astype(float), 1e-3, axis=(1, 2, 3))
    shear = np.sqrt(sum((part**2).sum(0) for part in gradient))[true.mask[0]]
    size = np.abs((measure_noise(true, model, 2).velocity - true.velocity)[:, 0][:, true.mask[0]])
    strong, weak = shear > 60, shear < 15
    assert strong.any() and weak.any()
    assert np.median(size[:, strong]) > 1.7 * np.median(size[:, weak])


def test_outliers_come_at_their_rate_and_fill_the_search_range():
    true = recording(uniform, frames=10)
    model = dataclasses.replace(STILL, lateral=0.0, axial=0.0, outliers=0.03, search=0.8)
    off, _ = error(measure_noise(true, model, 3), true)
    hopped = np.abs(off).max(axis=0) > 1e-4
    assert hopped.mean() == pytest.approx(0.03, rel=0.15)
    peak = off[:, hopped] + np.array([0.3, -0.2, 0.25])[:, None]
    assert np.abs(peak).max() <= 0.8 + 1e-6
    assert peak.std() == pytest.approx(0.8 / math.sqrt(3), rel=0.1)  # uniform over the range


def test_clutter_filter_loses_slow_axial_flow_alone():
    model = dataclasses.replace(STILL, lateral=0.0, axial=0.0, clutter=0.05)

    def reported(speed):
        true = recording(lambda x, y, z: (np.full_like(x, speed),) * 3, frames=2)
        return measure_noise(true, model, 4).velocity[0, :, 12, 9, 10]

    slow, fast = reported(0.02), reported(0.3)
    assert slow[2] < 0.3 * 0.02 and slow[0] == pytest.approx(0.02)
    assert fast[2] == pytest.approx(0.3, rel=1e-6)


def test_dropouts_fall_on_slow_axial_flow_and_carry_no_weight():
    model = NoiseModel(dropout=0.3)
    still = recording(lambda x, y, z: (np.full_like(x, 0.2), 0 * x, 0 * x), frames=8)
    gone = measure_noise(still, model, 5)
    lost = still.mask & (gone.weight == 0)
    assert lost.sum() / still.mask.sum() == pytest.approx(0.3, rel=0.25)
    assert not gone.velocity.transpose(0, 2, 3, 4, 1)[lost].any()
    moving = recording(uniform, frames=8)
    assert (measure_noise(moving, model, 5).weight[moving.mask] > 0).all()


def test_blur_averages_the_flow_over_three_millimetres():
    true = recording(lambda x, y, z: (np.sin(2 * np.pi * z / 8e-3), 0 * x, 0 * x), frames=2)
    model = NoiseModel(lateral=0.0, axial=0.0, outliers=0.0, clutter=None, dropout=0.0)
    seen = measure_noise(true, model, 6).velocity[0, 0, 8:16, 9, 10]
    deviation = 3e-3 / (2 * math.sqrt(2 * math.log(2)))
    expected = math.exp(-0.5 * (2 * np.pi / 8e-3 * deviation) ** 2) * true.velocity[0, 0, 8:16, 9, 10]
    np.testing.assert_allclose(seen, expected, atol=0.02)


def test_weight_is_weakly_informative_and_blind_to_the_drawn_noise():
    true = recording(vortex, frames=6)
    measured = measure_noise(true, NoiseModel(), 7)
    off, weight = error(measured, true)
    assert 0.05 < abs(spearmanr(weight, np.sqrt((off**2).sum(0))).statistic) < 0.4
    assert weight.min() > 0 and weight.max() <= 1 and weight.std() > 0.1
    # the very same weight comes with no noise at all, so it cannot have been computed from the error
    silent = measure_noise(true, NoiseModel(lateral=0.0, axial=0.0, outliers=0.0), 7)
    np.testing.assert_array_equal(measured.weight, silent.weight)


def test_every_third_frame_with_the_same_noise_as_in_the_full_series():
    true = recording(vortex, frames=7)
    full, third = measure_noise(true, NoiseModel(), 8), measure_noise(true, NoiseModel(every=3), 8)
    np.testing.assert_array_equal(third.time, true.time[::3])
    np.testing.assert_array_equal(third.velocity, full.velocity[::3])
    np.testing.assert_array_equal(third.mask, true.mask[::3])


def test_the_seed_decides_everything():
    true = recording(vortex, frames=2)
    first, again, other = (measure_noise(true, NoiseModel(), seed) for seed in (9, 9, 10))
    np.testing.assert_array_equal(first.velocity, again.velocity)
    np.testing.assert_array_equal(first.weight, again.weight)
    assert np.abs(first.velocity - other.velocity).max() > 0.05
    assert len({frame_seed(seed, frame) for seed in range(20) for frame in range(20)}) == 400


def test_walls_physics_and_file_survive(tmp_path):
    true = recording(vortex, frames=4)
    measured = measure_noise(true, NoiseModel(every=2), 0)
    np.testing.assert_array_equal(measured.wall.vertices, true.wall.vertices)
    assert (measured.rho, measured.mu) == (true.rho, true.mu)
    assert "lateral 0.06" in measured.description and "seed 0" in measured.description
    geometry.write_recording(tmp_path / "m.h5", measured)
    back = geometry.read_recording(tmp_path / "m.h5")
    np.testing.assert_array_equal(back.velocity, measured.velocity)
    np.testing.assert_array_equal(back.weight, measured.weight)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, "every"),
        ({"every": 1.5}, "every"),
        ({"lateral": -0.1}, "lateral"),
        ({"axial": math.nan}, "axial"),
        ({"outliers": 1.2}, "outliers"),
        ({"dropout": -1.0}, "dropout"),
        ({"blur": 0.0}, "blur"),
        ({"correlation": None}, "correlation"),
        ({"search": math.inf}, "search"),
        ({"beam_axis": 0.5}, "beam_axis"),
    ],
)
def test_bad_options_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        NoiseModel(**options)


def test_requests_that_do_not_fit_the_recording_are_refused():
    true = recording(uniform, frames=3)
    with pytest.raises(ValueError, match="every = 3 leaves one of 3 frames"):
        measure_noise(true, NoiseModel(every=3), 0)
    with pytest.raises(ValueError, match="beam_axis 3"):
        measure_noise(true, NoiseModel(beam_axis=3), 0)
    with pytest.raises(ValueError, match="seed"):
        measure_noise(true, NoiseModel(), -1)
