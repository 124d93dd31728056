"""The simulator's own pressure and acceleration on a grid, against a squeezed ball whose flow is known."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

import geometry
from torchsph import Scene, Simulator, Transfer
from torchsph.simulator.grid_forecast import GridForecast
from torchsph.simulator.transfer.pressure_fetching import PressureAverages

RADIUS, RHO = 0.01, 1060.0
TURNS, STROKE = 2 * np.pi / 0.2, 0.25
TIMES = np.linspace(0.0, 0.1, 41)


def strain(t):
    """q, q', q'' of a motion (x, y, z) exp(-q / 2, -q / 2, q) that keeps the volume."""
    return (
        STROKE * np.sin(TURNS * t),
        STROKE * TURNS * np.cos(TURNS * t),
        -STROKE * TURNS**2 * np.sin(TURNS * t),
    )


def stretch(t):
    q = strain(t)[0]
    return np.array([np.exp(-q / 2), np.exp(-q / 2), np.exp(q)])


def rates(t):
    """Velocity gradient (diagonal), 1/s, and its time derivative, 1/s^2."""
    _, first, second = strain(t)
    return first * np.array([-0.5, -0.5, 1.0]), second * np.array([-0.5, -0.5, 1.0])


def squeezed():
    """u = a(t) x in a ball that is squeezed: viscosity does nothing, p = -rho (a' + a^2) x^2 / 2 exactly."""
    ball = geometry.ellipsoid((RADIUS,) * 3, 1e-3)
    grid = geometry.Grid.covering((-1.3 * RADIUS,) * 3, (1.3 * RADIUS,) * 3, 1.25e-3)
    nodes = grid.nodes().numpy()
    masks = np.stack([(((nodes / stretch(t)) ** 2).sum(1) < RADIUS**2).reshape(grid.shape) for t in TIMES])
    field = np.stack([(nodes * rates(t)[0]).T.reshape(3, *grid.shape) for t in TIMES]) * masks[:, None]
    wall = geometry.Wall(
        np.stack([ball.vertices * stretch(t) for t in TIMES]),
        ball.faces,
        ball.region,
        np.stack([ball.vertices * stretch(t) * rates(t)[0] for t in TIMES]),
    )
    return geometry.Recording(TIMES, grid, field.astype(np.float32), masks, wall, rho=RHO, mu=4e-3)


def forecast(recording, spacing, start, end, spans):
    masks = [torch.from_numpy(np.array(recording.mask[k])) for k in (start, end)]
    model = Simulator(Scene.from_recording(recording, spacing))
    times = [float(recording.time[k]) for k in (start, end)]
    first = torch.from_numpy(recording.velocity[start])
    going = GridForecast(model, recording.grid, first, masks[0], times[0], Transfer(), rates=True)
    averages = PressureAverages(recording.grid, [masks[1]] * len(spans), spans)
    going.run.observers.append(partial(averages.note, going.run))
    going.at(times[1], masks[1])
    return going, averages.fields(1)[0].numpy(), masks


def exact_pressure(recording, t):
    a, change = rates(t)
    return -0.5 * RHO * (recording.grid.nodes().numpy() ** 2 @ (change + a**2)).reshape(recording.grid.shape)


@pytest.fixture(scope="module")
def recording():
    return squeezed()


def off(found, wanted, mask):
    found, wanted = found[mask] - found[mask].mean(), wanted[mask] - wanted[mask].mean()
    return float(np.sqrt(np.mean((found - wanted) ** 2) / np.mean(wanted**2)))


def test_pressure_and_rate_of_a_squeezed_ball(recording):
    start, end = 16, 20
    middle, last = 0.5 * (TIMES[start] + TIMES[end]), float(TIMES[end])
    errors, slopes = [], []
    for spacing in (2.5e-3, 1.25e-3):
        spans = [(float(TIMES[start]), last), (last, last + 1.0)]
        going, found, masks = forecast(recording, spacing, start, end, spans)
        assert np.isfinite(found[0][masks[1].numpy()]).all()
        assert np.isnan(found[1]).all()  # no step lies in that span
        mask = np.array(recording.mask[start] & recording.mask[end])
        errors.append(off(found[0], exact_pressure(recording, middle), mask))
        wanted = (recording.velocity[end] - recording.velocity[start]) / (TIMES[end] - TIMES[start])
        slope = going.rate()[0].numpy()
        assert np.isfinite(slope[:, mask]).all() and np.isnan(slope[:, ~mask]).all()
        slopes.append(np.sqrt(((slope - wanted)[:, mask] ** 2).mean() / (wanted[:, mask] ** 2).mean()))
    assert errors[1] < 0.04 and errors[1] < 0.6 * errors[0]
    assert slopes[1] < 0.06 and slopes[1] < 0.6 * slopes[0]


def test_looking_on_changes_no_bit(recording):
    model = Simulator(Scene.from_recording(recording, 2.5e-3))
    mask = torch.from_numpy(np.array(recording.mask[0]))
    runs = []
    for rates_asked in (False, True):
        first = torch.from_numpy(recording.velocity[0])
        going = GridForecast(model, recording.grid, first, mask, 0.0, Transfer(), rates=rates_asked)
        if rates_asked:
            averages = PressureAverages(recording.grid, [mask], [(0.0, 1.0)])
            going.run.observers.append(partial(averages.note, going.run))
        runs.append(going.at(0.005, mask)[0])
    assert torch.equal(*runs)


def test_a_rate_needs_to_be_asked_for(recording):
    model = Simulator(Scene.from_recording(recording, 2.5e-3))
    mask = torch.from_numpy(np.array(recording.mask[0]))
    going = GridForecast(model, recording.grid, torch.from_numpy(recording.velocity[0]), mask, 0.0, Transfer())
    going.at(0.0025, mask)
    with pytest.raises(ValueError, match="rates=True"):
        going.rate()
