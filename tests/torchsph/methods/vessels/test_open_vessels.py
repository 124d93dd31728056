"""Vessels with several openings: splines leave the flow through them alone, and tell the flux of each."""

from dataclasses import replace

import numpy as np
import pytest

import geometry
import torchsph as ts

RADIUS, LENGTH, PEAK = 0.01, 0.05, 0.6
TIME = np.array([0.0, 0.01, 0.02])


def parabolic(noise: float, *, intervals: bool = True) -> tuple[geometry.Recording, np.ndarray]:
    """A rigid tube along z with Poiseuille flow and white noise (m/s); the true velocity beside it."""
    tube = geometry.tube(RADIUS, LENGTH, 0.0015)
    grid = geometry.Grid.covering((-0.011, -0.011, 0), (0.011, 0.011, LENGTH), 0.0015)
    points = grid.nodes().numpy()
    square = (points[:, :2] ** 2).sum(1)
    mask = (square < RADIUS**2 * 0.999).reshape(grid.shape)
    true = np.zeros((3, 3, *grid.shape), np.float32)
    true[:, 2] = PEAK * np.where(mask, (1 - square / RADIUS**2).reshape(grid.shape), 0)
    noisy = true + np.where(mask, noise * np.random.default_rng(0).standard_normal(true.shape), 0)
    rows = np.array([[1.0, -1.0, 1.0], [2.0, -1.0, 1.0]]) if intervals else None
    wall = geometry.Wall(tube.vertices, tube.faces, tube.region)
    made = geometry.Recording(TIME, grid, noisy.astype(np.float32), mask, wall, 1060.0, 4e-3, valve_intervals=rows)
    return made, true


@pytest.mark.parametrize(
    "intervals",
    [pytest.param(True, id="times given"), pytest.param(False, id="times found", marks=pytest.mark.slow)],
)
def test_flow_through_open_ends_survives_smoothing(intervals):
    """Error at most .35 of the noise everywhere, the ends included; the flux within 2 % at every section."""
    recording, true = parabolic(0.05, intervals=intervals)
    smooth = ts.smooth(recording) if intervals else smoothed_with_a_word(recording)
    z = recording.grid.nodes().numpy()[:, 2].reshape(recording.grid.shape)
    mask = recording.mask[0]
    ends = mask & ((z < 0.004) | (z > LENGTH - 0.004))
    noise = recording.velocity - true
    for part in (mask, ends):
        left = np.sqrt(((smooth.velocity - true)[:, :, part] ** 2).sum() / (noise[:, :, part] ** 2).sum())
        assert left < 0.35
    for height in np.unique(z):
        section = mask & (z == height)
        flux = smooth.velocity[:, 2][:, section].mean() / true[:, 2][:, section].mean()
        assert flux == pytest.approx(1.0, abs=0.02)


def smoothed_with_a_word(recording: geometry.Recording) -> geometry.Recording:
    with pytest.warns(UserWarning, match="keep their volume: openings .* are taken for open"):
        return ts.smooth(recording)


def test_a_recording_without_walls_is_smoothed():
    recording, true = parabolic(0.05)
    bare = replace(recording, wall=None, valve_intervals=None)
    smooth = ts.smooth(bare)
    mask = bare.mask[0]
    left = ((smooth.velocity - true)[:, :, mask] ** 2).sum() / ((bare.velocity - true)[:, :, mask] ** 2).sum()
    assert np.sqrt(left) < 0.5
