"""Oscillating flow in a pipe at Womersley number 8 against the solution by Bessel functions."""

import math

import numpy as np
import pytest
import torch
from wall_cases import RADIUS, assert_nothing_went_wrong, axis_distance, fill_with, pipe

from torchsph import Scene, Simulator
from torchsph.validation import exact_wall_flows as validation_walls

NUMBER = 8.0
FREQUENCY = 1.0
RATE = 2 * math.pi * FREQUENCY
VISCOSITY = RADIUS**2 * RATE / NUMBER**2
FORCE = RATE  # 1 m/s where viscosity does not reach


def exact(radius, time):
    return validation_walls.womersley(radius, time, VISCOSITY, FORCE, FREQUENCY, RADIUS)


def measured(across, periods=1, frames=16):
    """Worst RMS error over the period and the mean flow's ratio to the exact one, complex: (amplitude's, ratio)."""
    run = pipe(across, VISCOSITY, lambda t: (0.0, 0.0, FORCE * math.cos(RATE * t)))
    fill_with(run, exact(axis_distance(run), 0.0))
    line = torch.linspace(0, RADIUS, 200, dtype=torch.float64)
    quarter = [exact(line, t) for t in np.linspace(0, 0.5, 41)]
    amplitude = float(torch.stack(quarter).abs().max())
    worst, flow, expected = 0.0, 0j, 0j
    for frame in range(1, periods * frames + 1):
        time = frame / frames / FREQUENCY
        run.advance(time)
        velocity, truth = run.particles.velocity[:, 2].double(), exact(axis_distance(run), time)
        worst = max(worst, float((velocity - truth).square().mean().sqrt()) / amplitude)
        turn = np.exp(-1j * RATE * time)
        flow, expected = flow + float(velocity.mean()) * turn, expected + float(truth.mean()) * turn
    assert_nothing_went_wrong(run)
    assert float(axis_distance(run).max()) < RADIUS
    return worst, flow / expected


def test_profile_and_phase_at_16_across():
    """The issue asks for 3 % of the amplitude and 3 degrees: 1.6 % and 0.2 degrees were measured, flow 0.3 % low."""
    worst, ratio = measured(16)
    assert worst < 0.02
    assert abs(np.degrees(np.angle(ratio))) < 0.5
    assert abs(ratio) == pytest.approx(1.0, abs=0.006)


def test_a_body_force_of_time_must_return_one_number_per_axis():
    scene = Scene(spacing=0.1, period=(1.0, 1.0), dimension=2, gravity=lambda t: (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="Scene.gravity must return 2 finite accelerations"):
        Simulator(scene).start(0.0).advance(0.01)


def test_a_body_force_of_time_moves_every_member_by_its_own_clock():
    """Fluid in a periodic box: its velocity is the integral of the force, 1 - cos t, to first order in the step."""
    scene = Scene(spacing=0.1, period=(1.0, 1.0), dimension=2, gravity=lambda t: (math.sin(t), 0.0))
    run = Simulator(scene, dtype=torch.float64).start(0.0, members=2)
    run.advance(1.0)
    moved = run.particles.per_member(run.particles.velocity[:, 0], "sum") / (run.particles.count / 2)
    np.testing.assert_allclose(moved, 1 - math.cos(1.0), rtol=0.02)
