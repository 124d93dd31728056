"""The flow between frames: what must be exact is, and the model brings in more than a straight line."""

from __future__ import annotations

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from ellipsoid_cases import TIMES, recorded

import geometry
import torchsph
from torchsph.cli.main import main
from torchsph.methods import between_frames
from torchsph.methods.between_frames import BetweenFrames
from torchsph.methods.resample import frame_times, resample
from torchsph.simulator.failures import NumericalFailure
from torchsph.validation.ellipsoid import PulsatingEllipsoid

MOMENTS = (0.0, 0.0025, 0.01, 0.0137, 0.02)


def straight(points: np.ndarray, time: float) -> np.ndarray:
    """Linear in time and space, without divergence."""
    away = points - 0.005
    return (1 + 30 * time) * np.stack([8 * away[:, 1], -3 * away[:, 0] + 2 * away[:, 2], 5 * away[:, 0] + 0.1], 1)


def bent(points: np.ndarray, time: float) -> np.ndarray:
    """Quadratic in time."""
    return straight(points, 400 * time**2)


def inner_points(count: int = 50) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.001, 0.009, (count, 3))


class WrongModel:
    """A forecast that is `flow` plus an error linear in time since its start; it stands where `GridForecast` does."""

    def __init__(self, flow, grid, start: float, error: float) -> None:
        self.flow, self.grid, self.start, self.error, self.now = flow, grid, start, error, start
        self.run = self

    def advance(self, time: float) -> None:
        assert time >= self.now - 1e-9
        self.now = time

    def fetch(self, grid: geometry.Grid, mask: torch.Tensor):
        points = grid.nodes().numpy()
        field = self.flow(points, self.now) + 0.03 + self.error * (self.now - self.start) * np.cos(300 * points)
        value = torch.from_numpy(np.ascontiguousarray(field.T)).float().reshape(3, *grid.shape)
        return SimpleNamespace(value=value[None], covered=mask[None])


# whose forecasts the tests replace
ANY_MODEL = torchsph.Simulator(torchsph.Scene(1e-3, period=(0.01, 0.01, 0.01)))


@pytest.fixture
def with_model(monkeypatch):
    """Makes `BetweenFrames` of a recording with a model that is wrong in a known way."""

    def make(recording, flow, error: float = 0.0) -> BetweenFrames:
        def forecast(model, grid, velocity, mask, time, transfer, *, seed=0):
            return WrongModel(flow, grid, time, error)

        monkeypatch.setattr(between_frames, "GridForecast", forecast)
        return BetweenFrames(recording, ANY_MODEL)

    return make


def test_a_flow_linear_in_time_and_space_is_reproduced(box_recording):
    flow, points = BetweenFrames(box_recording(straight)), inner_points()
    found = flow.at(MOMENTS[::-1], points)
    assert found.inside.all() and found.sigma is None
    for velocity, time in zip(found.velocity, MOMENTS[::-1], strict=True):
        np.testing.assert_allclose(velocity, straight(points, time), atol=2e-7)


def test_a_steady_flow_stays(box_recording):
    steady = box_recording(lambda points, time: straight(points, 0.0))
    found = resample(steady, times=MOMENTS)
    assert (found.velocity == found.velocity[0]).all() and (found.mask == steady.mask[0]).all()


def test_errors_of_the_forecast_that_grow_linearly_are_taken_out(box_recording, with_model):
    recording, points = box_recording(bent), inner_points()
    line = BetweenFrames(recording).at(MOMENTS, points).velocity
    found = with_model(recording, bent, error=40.0).at(MOMENTS, points).velocity
    exact = np.stack([bent(points, time) for time in MOMENTS])
    np.testing.assert_allclose(found, exact, atol=3e-6)
    assert np.abs(line - exact)[1].max() > 1e-3  # which the straight line is not


def test_frames_are_met_bit_for_bit(box_recording, with_model):
    recording = box_recording(bent)
    recording = replace(recording, sigma=np.full_like(recording.velocity, 0.04))
    flow = with_model(recording, straight, error=70.0)
    for frame, moment in enumerate(flow.moments(recording.time, recording.grid)):
        np.testing.assert_array_equal(moment.velocity, recording.velocity[frame])
        np.testing.assert_array_equal(moment.sigma, recording.sigma[frame])
        np.testing.assert_array_equal(moment.mask, recording.mask[frame])
    just_after = next(flow.moments([1e-5], recording.grid))
    assert np.abs(just_after.velocity - recording.velocity[0]).max() < 2e-3  # and nothing jumps beside them


def test_the_deviation_is_a_bridge(box_recording, with_model):
    recording = box_recording(straight)
    claimed = np.full_like(recording.velocity, 0.04)
    claimed[1] = 0.08
    recording = replace(recording, sigma=claimed * recording.mask[:, None])

    def drifting(points: np.ndarray, time: float) -> np.ndarray:
        return straight(points, time) + 12.0 * time  # what is missed over 10 ms is 0.12 m/s everywhere

    flow = with_model(recording, drifting)
    for share in (0.25, 0.5):
        sigma = flow.at([share * 0.01], inner_points()).sigma
        variance = (1 - share) * 0.04**2 + share * 0.08**2 + share * (1 - share) * 0.12**2
        np.testing.assert_allclose(sigma, variance**0.5, rtol=1e-3)
    np.testing.assert_allclose(flow.at([0.01], inner_points()).sigma, 0.08, rtol=1e-6)


def test_points_outside_have_no_flow(box_recording):
    found = BetweenFrames(box_recording(straight)).at([0.005], [[0.02, 0.005, 0.005], [0.005, 0.005, 0.005]])
    assert found.inside.tolist() == [[False, True]] and (found.velocity[0, 0] == 0).all()
    bare = BetweenFrames(replace(box_recording(straight), wall=None))
    np.testing.assert_array_equal(bare.at([0.005], inner_points()).velocity[0].shape, (50, 3))


def test_a_model_that_fails_leaves_straight_lines_and_says_so(box_recording, monkeypatch):
    def broken(*args, **kwargs):
        raise NumericalFailure("it blew up")

    monkeypatch.setattr(between_frames, "GridForecast", broken)
    recording, points = box_recording(straight), inner_points()
    flow = BetweenFrames(recording, ANY_MODEL)
    with pytest.warns(RuntimeWarning, match="linear in time from there to 0.01 s"):
        found = flow.at([0.005], points)
    np.testing.assert_allclose(found.velocity[0], straight(points, 0.005), atol=2e-7)
    assert flow.failures == {0: "it blew up"}


@pytest.fixture(scope="module")
def pulsating() -> tuple[PulsatingEllipsoid, geometry.Recording]:
    body = PulsatingEllipsoid()
    return body, recorded(body)


def test_sph_between_frames_of_a_moving_wall(pulsating):
    """The exact potential flow in a body whose wall moves: the mask and the walls go along, the flow is met."""
    body, recording = pulsating
    frames = recording.select([0, 2, 3])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = resample(frames, torchsph.make_model(frames), times=TIMES)
    np.testing.assert_allclose(found.time, TIMES)
    np.testing.assert_array_equal(found.velocity[0], frames.velocity[0])
    np.testing.assert_array_equal(found.velocity[2:], frames.velocity[1:])
    np.testing.assert_allclose(found.wall.vertices[1], recording.wall.vertices[1], atol=2e-5)
    assert (found.mask[1] != recording.mask[1]).mean() < 2e-3
    both = found.mask[1] & recording.mask[1]
    error = np.linalg.norm((found.velocity[1] - recording.velocity[1])[:, both])
    assert error < 0.05 * np.linalg.norm(recording.velocity[1][:, both])
    found.check()


def test_a_finer_grid(pulsating):
    _, recording = pulsating
    fine = resample(recording, times=[TIMES[0], TIMES[0] + 0.004], spacing=1e-3)
    assert fine.grid.spacing == (1e-3,) * 3 and fine.frames == 2
    volume = fine.mask.sum((1, 2, 3)) * fine.grid.cell_volume
    exact = [geometry.WallMotion.from_recording(recording).volume(float(t)) for t in fine.time]
    np.testing.assert_allclose(volume, exact, rtol=0.03)
    fine.check()


def test_what_cannot_be_is_refused(box_recording):
    recording = box_recording(straight)
    flow = BetweenFrames(recording)
    with pytest.raises(ValueError, match="known from 0 to 0.02 s"):
        flow.at([0.03], inner_points())
    with pytest.raises(ValueError, match="must not decrease"):
        list(flow.moments([0.01, 0.0], recording.grid))
    with pytest.raises(ValueError, match="at least 2 frames"):
        BetweenFrames(recording.select([0]))
    holes = np.array(recording.velocity)
    holes[1, 0, np.array(recording.mask[1], bool)] = np.nan
    weight = np.where(np.isfinite(holes).all(1), 1.0, 0.0).astype(np.float32)
    for gap in (replace(recording, velocity=holes), replace(recording, weight=weight)):
        with pytest.raises(ValueError, match="nothing is known at .* nodes in the blood, first at frame 1; smooth or"):
            BetweenFrames(gap)
    with pytest.raises(ValueError, match="times must increase"):
        resample(recording, times=[0.01, 0.01])
    with pytest.raises(ValueError, match="it is in metres"):
        resample(recording, spacing=1e-5)
    with pytest.raises(ValueError, match="frame rate must be positive"):
        frame_times(recording.time, 0.0)
    np.testing.assert_allclose(frame_times(np.array([0.1, 0.2, 0.3]), 30.0), 0.1 + np.arange(7) / 30.0)


def test_the_command(tmp_path, box_recording, capsys):
    recording = box_recording(straight)
    geometry.write_recording(tmp_path / "a.h5", recording)
    command = ["resample", str(tmp_path / "a.h5"), "--linear", "--out", str(tmp_path / "r.h5")]
    assert main([*command, "--frame-rate", "400"]) == 0
    found = geometry.read_recording(tmp_path / "r.h5")
    np.testing.assert_allclose(found.time, np.arange(9) / 400)
    inside = found.mask[3]
    exact = straight(found.grid.nodes().numpy(), found.time[3]).T.reshape(3, *found.grid.shape)
    np.testing.assert_allclose(found.velocity[3][:, inside], exact[:, inside], atol=2e-7)
    assert main([*command, "--times", "0.5"]) == 2
    assert "known from 0 to 0.02 s" in capsys.readouterr().err
