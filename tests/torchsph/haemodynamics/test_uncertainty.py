"""Bands hold what they say, moments taken one at a time are those of the stack."""

from __future__ import annotations

import numpy as np
import pytest

from torchsph.haemodynamics.uncertainty import RunningMoments, around, coverage, summary, unresolved


@pytest.mark.parametrize("members", [4, 16, 64])
def test_the_band_holds_nine_of_ten_at_any_number_of_members(members):
    draws = np.random.default_rng(0).normal(3.0, 2.0, size=(members + 1, 20000))
    assert coverage(summary(draws[:-1]), draws[-1]) == pytest.approx(0.9, abs=0.01)


def test_mean_and_deviation():
    values = np.array([[1.0, 2.0], [3.0, 6.0], [5.0, 4.0]])
    found = summary(values)
    assert found.mean.tolist() == [3.0, 4.0] and found.deviation.tolist() == [2.0, 2.0]
    assert (found.low < found.mean).all() and (found.high > found.mean).all()
    with pytest.raises(ValueError, match="at least 2"):
        summary(values[:1])


def test_what_members_lack_together_widens_the_band():
    values = np.array([[1.0, 2.0], [3.0, 6.0], [5.0, 4.0]])
    wide = summary(values, [0.0, 1.5])
    assert wide.deviation.tolist() == [2.0, 2.5] and wide.mean.tolist() == [3.0, 4.0]
    np.testing.assert_allclose(
        (wide.high - wide.mean) / summary(values).deviation, (summary(values).high - 3.0)[0] / 2 * np.array([1.0, 1.25])
    )
    # the larger of what the variance adds to the estimate's and of what a second pass takes
    assert unresolved([2.0, 3.5], values).tolist() == [1.0, 0.5]
    assert unresolved([2.0, 3.5], values, [1.5, 1.0]).tolist() == [1.0, 2.5]


def test_a_band_holds_nine_of_ten_of_what_all_members_miss():
    """An error that all members share, of a size that is known: without it the band holds far too few."""
    draws = np.random.default_rng(3)
    true, *members = draws.normal(size=(17, 20000))
    members = np.stack(members) + 2.0 * draws.normal(size=20000)
    assert coverage(summary(members), true) < 0.65
    assert coverage(summary(members, 2.0), true) == pytest.approx(0.9, abs=0.03)


def test_members_around_a_control():
    members = np.random.default_rng(1).normal(size=(5, 3, 4))
    moved = around(np.full((3, 4), 7.0), members, 0.5)
    np.testing.assert_allclose(moved.mean(0), 7.0)
    np.testing.assert_allclose(moved.std(0), 0.5 * members.std(0))


def test_what_is_missing_does_not_count():
    found = summary(np.array([[0.0, np.nan], [1.0, 0.0]]))
    assert coverage(found, [0.5, 1.0]) == 1.0
    assert np.isnan(coverage(found, [np.nan, 1.0]))


def test_running_moments_are_those_of_the_stack():
    fields = 1e3 + np.random.default_rng(2).normal(size=(7, 2, 3))
    running = RunningMoments().extend(fields)
    np.testing.assert_allclose(running.mean, fields.mean(0), rtol=1e-14)
    np.testing.assert_allclose(running.deviation, fields.std(0, ddof=1), rtol=1e-10)
    with pytest.raises(ValueError, match="at least 2"):
        _ = RunningMoments().extend(fields[:1]).deviation
    with pytest.raises(ValueError, match="no field"):
        _ = RunningMoments().mean
