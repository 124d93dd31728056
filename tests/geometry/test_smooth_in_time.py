"""Smoothing splines in time: exact on what they must not touch, calibrated on noise, the penalty's own minimiser."""

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from geometry.motion.smooth_in_time import ORDER, SplineInTime

UNEVEN = np.sort(np.concatenate([np.linspace(0.0, 0.8, 33), [0.013, 0.41]]))


def wave(t):
    return np.sin(2 * np.pi * t / 0.8) + 0.3 * np.cos(4 * np.pi * t / 0.8)


def slope(t):
    return 2 * np.pi / 0.8 * (np.cos(2 * np.pi * t / 0.8) - 0.6 * np.sin(4 * np.pi * t / 0.8))


@pytest.mark.parametrize(("time", "period"), [(UNEVEN, 0.0), (np.linspace(0, 0.8, 40, endpoint=False), 0.8)])
def test_a_smooth_series_is_left_alone_and_its_rate_found(time, period):
    found = SplineInTime(time, period).fit(wave(time)[:, None])
    assert found.noise[0] < 1e-5
    np.testing.assert_allclose(found.value[:, 0], wave(time), atol=1e-7)
    inner = slice(2, -2)
    np.testing.assert_allclose(found.rate[inner, 0], slope(time)[inner], atol=0.02 * np.abs(slope(time)).max())


def test_polynomials_of_the_null_space_pass_unchanged():
    series = np.stack([UNEVEN**k for k in range(ORDER)], 1) + 5.0
    found = SplineInTime(UNEVEN).fit(series)
    np.testing.assert_allclose(found.value, series, rtol=1e-9)
    np.testing.assert_allclose(found.rate, np.stack([k * UNEVEN ** max(k - 1, 0) for k in range(ORDER)], 1), atol=1e-6)


@pytest.mark.parametrize("period", [0.0, 0.8])
@pytest.mark.parametrize("level", [0.02, 0.1])
def test_noise_is_found_and_deviations_are_the_errors(period, level):
    time = np.linspace(0, 0.8, 41)[:-1]
    generator = np.random.default_rng(1)
    found = SplineInTime(time, period).fit(wave(time)[:, None] + level * generator.standard_normal((40, 300)))
    assert found.noise.mean() == pytest.approx(level, rel=0.08)
    error = found.value - wave(time)[:, None]
    assert error.std() < 0.65 * level
    assert (error / np.sqrt(found.value_variance)).std() == pytest.approx(1.0, abs=0.15)
    assert (found.rate - slope(time)[:, None]).std() / np.sqrt(found.rate_variance.mean()) == pytest.approx(
        1.0, abs=0.3
    )


def test_without_noise_the_spline_is_the_natural_interpolant():
    """SciPy's natural quintic is the interpolant of least third derivative: the limit of no noise."""
    time = np.linspace(0, 1, 12)
    values = np.exp(time) * np.sin(5 * time)
    spline = SplineInTime(time)
    rate = spline._rate_maps(np.array([1e-14]))[0] @ values
    natural = make_interp_spline(time, values, k=5, bc_type=([(3, 0.0), (4, 0.0)], [(3, 0.0), (4, 0.0)]))
    np.testing.assert_allclose(rate, natural.derivative()(time), rtol=1e-4)


def test_too_few_times_are_refused():
    with pytest.raises(ValueError, match="at least 6 times, got 5"):
        SplineInTime(np.arange(5.0))
