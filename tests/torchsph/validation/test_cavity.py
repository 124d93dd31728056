"""Lid-driven cavity: velocities on the centre lines against Ghia, Ghia & Shin (1982), and what the lid needs."""

import csv

import numpy as np
import pytest
import torch
from paths import TEST_DATA

from torchsph import CompleteKernelWall, WeaklyCompressible
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.walls.completeness import KernelCompleteness
from torchsph.validation import exact_flows as validation
from torchsph.validation.runs import lid_driven_cavity, velocity_at

EXPERIMENTS = TEST_DATA / "experiments"
# v at Re 400 and x = 0.9063 is printed as -0.23827 between -0.22847 and -0.44993; a finite-difference solution on 96^2
# cells, within 0.008 of all the other values, has -0.377 there
MISPRINT = (400, 0.9063)


def ghia(component, reynolds):
    """Positions (n,) inside the cavity and velocities (n,) along a centre line, without the misprint."""
    file = EXPERIMENTS / f"ghia_1982_{component}.csv"
    rows = [row for row in csv.reader(file.open()) if row and not row[0].startswith("#")]
    place, value = np.array(rows[1:], float)[:, [0, rows[0].index(f"Re{reynolds}")]].T
    keep = (place > 0) & (place < 1)
    if component == "v" and reynolds == MISPRINT[0]:
        keep &= place != MISPRINT[1]
    return place[keep], value[keep]


def cavity_errors(across, reynolds, time, **changes):
    """RMS errors of u and v along the centre lines over the lid's speed, means of the last 2 s; and the run."""
    scheme = WeaklyCompressible(**(validation.CAVITY_OPTIONS | changes))
    run = lid_driven_cavity(across, reynolds, scheme=scheme)
    (y, u), (x, v) = ghia("u", reynolds), ghia("v", reynolds)
    points = np.concatenate([np.stack([np.full_like(y, 0.5), y], 1), np.stack([x, np.full_like(x, 0.5)], 1)])
    late = np.linspace(time - 2.0, time, 5)
    seen = []
    for until in late:
        run.advance(until)
        seen.append(velocity_at(run, points))
    mean = np.mean(seen, 0)
    assert int(run.record.outside.sum()) == 0 and not bool(run.record.failed.any())
    errors = mean[: len(y), 0] - u, mean[len(y) :, 1] - v
    return *(float(np.sqrt(np.mean(e**2))) for e in errors), run


@pytest.mark.slow
def test_reynolds_100():
    """Within 1 % RMS of the lid's speed (2 % asked for) at 20^2 already: measured 0.54 and 0.20 % for u and v."""
    u, v, run = cavity_errors(20, 100, 8.0)
    assert max(u, v) < 0.01
    # the mean density is held: rounding of float32 over some thousand steps is all that is left
    assert abs(float(run.particles.deviation.mean())) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("across", "reynolds", "time"), [(40, 100, 15.0), (48, 400, 30.0), (60, 1000, 45.0)])
def test_ghia(across, reynolds, time):
    """Within 2 % RMS of the lid's speed: measured, u and v, 0.4 and 0.4 %, 0.3 and 0.3 %, 1.0 and 0.5 %.

    The flow at Re 1000 takes 40 s to become steady; 48^2 particles are 2.1 and 1.9 % off there.
    """
    assert max(cavity_errors(across, reynolds, time)[:2]) < 0.02


def test_a_sliding_lid_sweeps_nothing():
    """Beside the lid's ends the nearest wall's velocity would push the side walls: a density rate of order 1 / h."""
    across = 16
    options = validation.CAVITY_OPTIONS | {"density_diffusion": None, "constant_volume": False}
    rates = {}
    for sliding in (False, True):
        scheme = WeaklyCompressible(**(options | {"wall": CompleteKernelWall(sliding=sliding)}))
        run = lid_driven_cavity(across, 100.0, scheme=scheme)
        axis = torch.linspace(0.1, across - 0.1, 60)
        points = torch.cartesian_prod(axis, axis)
        run.surroundings.enter(0.0, 0.0)
        wall = run.surroundings.sample_at(points)
        nearest = (wall.velocity * wall.completeness_gradient).sum(1)
        rates[sliding] = nearest if wall.swept is None else wall.swept
    assert float(rates[False].abs().max()) > 0.15
    assert float(rates[True].abs().max()) < 1e-6


def test_a_wall_that_moves_inwards_sweeps_what_its_completeness_says():
    """A tilted plane that moves along its normal at unit speed: the completeness's gradient along the normal.

    Within 1 % in total and 5 % of the peak anywhere, because the surface is smeared over two cells.
    """
    step, normal = 0.5, torch.tensor([0.6, 0.8], dtype=torch.float64)
    axis = torch.arange(-8.0, 8.0 + step, step, dtype=torch.float64)
    distance = normal[0] * axis[None, :] + normal[1] * axis[:, None]
    made = KernelCompleteness(distance.shape, step, kernel("wendland_c2"), 1.3, torch.float64)
    along = (normal[:, None, None] * made.at(distance)[1]).sum(0)
    every = normal[:, None, None].expand(-1, *distance.shape)
    swept = made.swept(distance, torch.ones_like(distance), every)[0]
    inner = (slice(12, -12), slice(12, -12))  # away from the grid's edge, where the plane ends
    assert float((swept - along)[inner].abs().max()) < 0.05 * float(along.max())
    assert float(swept[inner].sum()) == pytest.approx(float(along[inner].sum()), rel=0.01)
