"""Forecasts of a grid: they beat persistence on a flow whose future is known, and pool errors as documented."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from torchsph import NumericalFailure, Scene, Simulator, Transfer, skill
from torchsph.simulator.grid_forecast import GridForecast

BALL = geometry.ellipsoid((0.008, 0.008, 0.008), 1.5e-3)
SPIN = np.array([0.0, 0.0, 30.0])  # 1/s


def solid_rotation(frames=4, step=0.005):
    """A ball of fluid at rest in a wall that stands still, with a vortex ring that decays slowly."""
    grid = geometry.Grid.covering((-0.009,) * 3, (0.009,) * 3, 1.5e-3)
    nodes = grid.nodes().numpy()
    radius = np.linalg.norm(nodes, axis=1)
    mask = (radius < 0.008).reshape(grid.shape)
    envelope = np.clip(1 - (radius / 0.008) ** 2, 0, None)[:, None]
    field = (np.cross(SPIN, nodes) * envelope).T.reshape(3, *grid.shape) * mask
    time = step * np.arange(frames)
    wall = geometry.Wall(BALL.vertices, BALL.faces, BALL.region)
    return geometry.Recording(
        time=time,
        grid=grid,
        velocity=np.stack([field] * frames).astype(np.float32),
        mask=mask,
        wall=wall,
        rho=1060.0,
        mu=1e-6,
    )


@pytest.fixture(scope="module")
def recording():
    return solid_rotation()


@pytest.fixture(scope="module")
def model(recording):
    return Simulator(Scene.from_recording(recording, 1.5e-3))


def test_a_steady_vortex_stays(recording, model):
    """Axisymmetric rotation is a steady Euler flow; what 11 particles across and a no-slip wall lose of it is small."""
    result = skill(recording, model, (0.005, 0.01), every=3)
    assert [row["starts"] for row in result.leads] == [1, 1]
    assert result.leads[0]["nrmse"]["persistence"] == 0.0
    assert result.leads[0]["nrmse"]["model"] < 0.10
    assert result.leads[1]["nrmse"]["model"] < 0.15


def test_no_lead_gives_back_the_start_when_the_lost_detail_is_added(recording, model):
    mask = torch.from_numpy(np.array(recording.mask[0]))
    start = torch.from_numpy(recording.velocity[0])
    going = GridForecast(model, recording.grid, start, mask, 0.0, Transfer())
    value, covered = going.at(0.0, mask)
    assert covered[0][mask].all()
    torch.testing.assert_close(value[0][:, mask], start[:, mask], atol=1e-6, rtol=0)


def test_saved_forecasts_are_recordings_valid_at_their_time(recording, model):
    result = skill(recording, model, (0.005,), every=2, save=True)
    saved = result.recordings[0.005]
    geometry.check_recording(saved, "forecast")
    np.testing.assert_allclose(saved.time, recording.time[[1, 3]])
    assert saved.uncovered.tolist() == [0, 0]


def test_a_lead_that_no_frame_has_is_refused(recording, model):
    with pytest.raises(ValueError, match="no frame of the recording lies 0.007 s after a start"):
        skill(recording, model, (0.007,))


def test_options_are_checked():
    with pytest.raises(ValueError, match="Transfer.fade"):
        Transfer(fade=0.0)


def test_a_start_that_fails_is_named_and_the_others_count(recording, model):
    wild = np.array(recording.velocity)
    wild[1] *= 1e30
    result = skill(replace(recording, velocity=wild), model, (0.005,))
    assert [(one["frame"], one["time"]) for one in result.failures] == [(1, 0.005)]
    assert "failed" in result.failures[0]["reason"]
    assert result.leads[0]["starts"] == 2
    with pytest.raises(NumericalFailure, match="all 1 starts failed"):
        skill(replace(recording, velocity=wild).select([1, 2]), model, (0.005,))
