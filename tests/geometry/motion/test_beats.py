"""Several beats of one recording: stitched onto one, and told apart where they do not repeat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import geometry
from geometry import Grid, Recording
from torchsph.methods.measurement.beats import stitched

PERIOD = 0.4  # s
NOISE = 0.05  # m/s


def beats(change: float = 0.0, count: int = 3, *, stated: bool = True, interval: float = 0.03) -> Recording:
    """A pulsating vortex with white noise, not commensurate with the frames; later beats add ``change`` m/s to it."""
    draw = np.random.default_rng(0)
    time = np.arange(0.1, 0.1 + count * PERIOD - 1e-9, interval)
    grid = Grid((-0.01, -0.01), (1e-3, 1e-3), (21, 21))
    x, y = grid.nodes().numpy().T.reshape(2, *grid.shape) / 0.01
    mask = x**2 + y**2 < 1
    fields = []
    for t in time:
        beat = int((t - 0.1) / PERIOD)
        swirl = (0.3 + 0.1 * np.sin(2 * np.pi * t / PERIOD)) * np.stack([-y, x])
        other = change * beat * np.stack([np.cos(3 * y), np.sin(3 * x)])
        fields.append((swirl + other + NOISE * draw.standard_normal(swirl.shape)) * mask)
    sigma = np.full((len(time), 2, *grid.shape), NOISE) if stated else None
    valves = np.array([[1, 0.1 + PERIOD * k, 0.2 + PERIOD * k] for k in range(count)])
    return Recording(
        time,
        grid,
        np.stack(fields),
        mask,
        None,
        1060.0,
        0.004,
        period=PERIOD,
        sigma=sigma,
        valve_intervals=valves,
    )


def test_times_are_phases_and_no_frame_is_lost() -> None:
    whole = beats()
    parts = geometry.split_beats(whole)
    assert len(parts) == 3 and sum(part.frames for part in parts) == whole.frames
    for number, part in enumerate(parts):
        assert part.time.min() >= 0.1 - 1e-9 and part.time.max() < 0.1 + PERIOD
        before = np.isclose(whole.time[:, None], part.time + number * PERIOD).any(1)
        np.testing.assert_array_equal(part.velocity, whole.velocity[before])
        np.testing.assert_allclose(part.valve_intervals, [[1, 0.1, 0.2]])
    begun = geometry.split_beats(whole.select(slice(3, None)).select(slice(None, 20)))
    assert begun[0].time[-1] - begun[0].time[0] > PERIOD - 0.05  # a whole one first
    with pytest.raises(ValueError, match="no period"):
        geometry.split_beats(replace(whole, period=0.0))
    with pytest.raises(ValueError, match="no beat"):
        geometry.split_beats(whole.select(slice(0, 5)))


@pytest.mark.parametrize("stated", [True, False])
def test_beats_that_repeat_differ_by_their_noise(stated: bool) -> None:
    recording = beats(stated=stated, interval=0.02)
    parts, found = stitched([recording])
    assert found is not None and found.repeats and found.compared > 1000
    assert found.difference == pytest.approx(NOISE, rel=0.05) and found.noise == pytest.approx(NOISE, rel=0.15)
    assert all((part.sigma is None) != stated for part in parts)


def test_beats_that_do_not_repeat_are_noticed_and_weigh_less() -> None:
    recording = beats(0.1, 2, interval=0.02)
    with pytest.warns(UserWarning, match="beats do not repeat"):
        (first, other), found = stitched([recording])
    # the second differs from the first by a field of RMS 0.1 / sqrt(2) a component: half of it is each one's
    assert found is not None and found.excess == pytest.approx(0.1 / 2, rel=0.25)
    np.testing.assert_allclose(first.sigma, NOISE)
    np.testing.assert_allclose(other.sigma, np.sqrt(NOISE**2 + 2 * found.excess**2), rtol=1e-5)


def test_nothing_is_compared_where_nothing_can_be() -> None:
    parts = geometry.split_beats(beats(interval=0.02))
    assert geometry.repetition(parts[:1], NOISE) is None
    shifted = [parts[0], replace(parts[1], time=parts[1].time + 0.01)]
    assert geometry.repetition(shifted, NOISE) is None
    with pytest.raises(ValueError, match="wants the noise"):
        geometry.repetition(geometry.split_beats(beats(stated=False)))
