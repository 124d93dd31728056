"""SPHERIC test 2, a dam break on an obstacle: pressure and arrival of the wave against Kleefsman et al. 2005."""

import math

import numpy as np
import pytest
import torch
from paths import TEST_DATA

from torchsph import Simulator, WeaklyCompressible
from torchsph.simulator.surroundings import PresentSurroundings
from torchsph.validation.dam_breaks import (
    GRAVITY,
    IMPACT_OPTIONS,
    OBSTACLE_COLUMN,
    OBSTACLE_PROBES,
    obstacle_pressures,
    obstacle_run,
    obstacle_scene,
)

EXPERIMENTS = TEST_DATA / "experiments"
# the digitised times are in sqrt(H / g): the wave then meets P1 at 0.39 s, within the 0.4 to 0.5 s of the paper's
# pictures; in sqrt(H / 2 g) it would be 0.28 s
TIME_UNIT = math.sqrt(OBSTACLE_COLUMN[1][2] / GRAVITY)
ARRIVED = 0.3  # of rho g H


def measured(probe):
    """(time in s, p / (rho g H)) of the experiment."""
    file = EXPERIMENTS / f"kleefsman_2005_{probe}.csv"
    time, pressure = np.loadtxt(file, delimiter=",", skiprows=2).T
    return time * TIME_UNIT, pressure


def arrival(time, pressure):
    """When the pressure first passes ARRIVED, s, between two samples."""
    k = int(np.argmax(pressure > ARRIVED))
    share = (ARRIVED - pressure[k - 1]) / (pressure[k] - pressure[k - 1])
    return float(time[k - 1] + share * (time[k] - time[k - 1]))


def test_the_obstacle_stands_in_the_tank():
    """Particles see the walls where they are: at the probes, in the solid, above it, beside it on the floor."""
    spacing = 0.05
    simulator = Simulator(obstacle_scene(spacing))
    surface = simulator.scene.walls.surface(0.0)
    assert surface.is_closed
    assert surface.volume == pytest.approx(3.22 - 0.16 * 0.4 * (0.161 + 2 * spacing), rel=1e-6)
    surroundings = PresentSurroundings(simulator.domain)
    surroundings.enter(0.0, 0.0)
    points = [*OBSTACLE_PROBES, (2.5, 0.0, 0.181), (2.40, 0.0, 0.03), (1.0, 0.0, 0.06), (2.5, 0.0, 0.08)]
    distance = surroundings.sample_at(torch.tensor(points) / spacing).distance * spacing
    expected = torch.tensor([0.0, 0.0, 0.02, 0.02, 0.06])
    torch.testing.assert_close(distance[:-1], expected, atol=0.15 * spacing, rtol=0.0)
    assert float(distance[-1]) < -spacing  # the middle of the obstacle


@pytest.mark.slow
def test_dam_break_on_an_obstacle():
    """Measured at 0.04 m (10850 particles, 4 to the obstacle's height), means over 20 ms, from 0.3 to 1.45 s.

    The wave arrives 29 ms (P1) and 35 ms (P3) late. Impulse 16 % too high at P1 and 28 % too low at P3, RMS difference
    0.34 and 0.24 rho g H, peak 1.76 against 2.01 at P1 and 0.66 against 1.20 at P3 (not asserted). At 0.025 m, with the
    walls of an earlier day: 32 and 59 ms late, impulses 28 % high and 31 % low: more particles alone are no cure.
    ``IMPACT_OPTIONS``, the probes without tension and the mean over 20 ms were chosen on this very experiment: these
    figures are a fit's, and no prediction.
    """
    scene = obstacle_scene(0.04)
    options = IMPACT_OPTIONS | {"sound_speed": 10.0 * scene.reference_speed}
    run = obstacle_run(Simulator(scene, WeaklyCompressible(**options)))
    time, raw = obstacle_pressures(run, 1.5)
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    assert float(run.record.smallest_density) > 0.85 and float(run.record.largest_density) < 1.15
    inside = (time > 0.3) & (time < 1.45)
    bounds = {"P1": ((1.0, 1.3), 0.42), "P3": ((0.6, 0.9), 0.30)}
    for k, (probe, (impulse, scatter)) in enumerate(bounds.items()):
        at, expected = measured(probe)
        truth = np.interp(time[inside], at, expected)
        pressure = np.convolve(raw[:, k], np.full(4, 0.25), "same")[inside]
        assert 0.0 < arrival(time, raw[:, k]) - arrival(at, expected) < 0.045
        assert impulse[0] < pressure.sum() / truth.sum() < impulse[1]
        assert np.sqrt(np.mean((pressure - truth) ** 2)) < scatter
        if probe == "P1":
            assert 1.5 < pressure[:40].max() < 2.3  # 2.01 measured
