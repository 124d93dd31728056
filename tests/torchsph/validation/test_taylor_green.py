"""Taylor-Green vortices: velocity error and order in the plane, kinetic energy in space against a grid solver."""

import csv
import math

import numpy as np
import pytest
from paths import TEST_DATA

from torchsph import Projection, WeaklyCompressible, preset
from torchsph.validation import exact_flows as validation
from torchsph.validation.runs import kinetic_energy, taylor_green, taylor_green_error

DECAY_TIME = 100 / (8 * math.pi**2)  # at Re 100
EXPERIMENTS = TEST_DATA / "experiments"


def plane_error(resolution, duration, **changes):
    """Relative L2 velocity error at Re 100 after ``duration`` with the options for periodic flows."""
    run = taylor_green(resolution, scheme=WeaklyCompressible(**(validation.PERIODIC_OPTIONS | changes)))
    run.advance(duration)
    assert not bool(run.record.failed.any())
    return taylor_green_error(run)


def test_taylor_green_2d_after_one_decay_time():
    """L2 error at Re 100 within 3 % at 25^2 and 1 % at 50^2 (measured 2.6 and 0.88 %); 100^2 is the slow test."""
    errors = [plane_error(n, DECAY_TIME) for n in (25, 50)]
    assert errors[0] < 0.03 and errors[1] < 0.01
    assert validation.observed_order([1 / 25, 1 / 50], errors) > 1.4


def projected_error(resolution, **changes):
    """The same error of incompressible steps."""
    run = taylor_green(resolution, scheme=Projection(**(validation.PERIODIC_PROJECTION | changes)))
    run.advance(DECAY_TIME)
    assert not bool(run.record.failed.any()) and not bool(run.record.unconverged.any())
    return taylor_green_error(run)


def test_taylor_green_2d_by_projection():
    """No worse than the weakly compressible scheme at equal spacing, in half of its time: 0.63 % at 40^2 (1.2 %).

    At 60^2 and 80^2 0.53 and 0.38 % (0.57 and 0.40 %: see the slow test); on 20^2 twice as bad, 5.9 % (3.7 %).
    """
    assert projected_error(40) < 0.008


@pytest.mark.slow
@pytest.mark.parametrize("resolution, error", [(60, 0.0057), (80, 0.0040)])
def test_taylor_green_2d_by_projection_at_fine_spacings(resolution, error):
    """``error`` is that of the weakly compressible options; a relaxation of 2 leaves 3 % at 60^2."""
    assert projected_error(resolution) < error
    if resolution == 60:
        assert projected_error(resolution, relaxation=2.0, shifting=2.0) > 0.02


def test_what_the_ventricles_preset_costs_a_vortex():
    """Its relaxation and shifting are for jets that fill a chamber: at most 1.9 times the error, at 40^2."""
    scheme = preset("projection", max_step=None, longest_step=None)
    changes = {"relaxation": scheme.relaxation, "shifting": scheme.shifting}
    assert 1.0 < projected_error(40, **changes) / projected_error(40) < 1.9


@pytest.mark.slow
def test_taylor_green_2d_at_100():
    """L2 error within 0.3 % at 100^2 and order 1.5 over 25^2 to 100^2 (measured 0.27 % and 1.62)."""
    errors = [plane_error(n, DECAY_TIME) for n in (25, 50, 100)]
    assert errors[2] < 0.003
    assert validation.observed_order([1 / 25, 1 / 50, 1 / 100], errors) > 1.5


@pytest.mark.slow
def test_shifting_by_the_largest_speed_is_what_keeps_particles_even():
    """With the particle's own speed the lattice breaks up where the fluid rests; the default's strength is far less."""
    even = plane_error(25, 0.5)
    assert plane_error(25, DECAY_TIME, shifting_speed="local") > 1.3 * plane_error(25, DECAY_TIME)
    assert plane_error(25, 0.5, shifting_speed="local", shifting=0.5) > 7 * even


def energy_table(reynolds):
    """Rows (time, kinetic energy) of JAX-Fluids on 64^3 cells.

    A pseudo-spectral solution on 48^3 modes, made once for this purpose, agrees with them within 0.3 % until t = 5.
    """
    file = EXPERIMENTS / f"tgv3d_Re{reynolds}.csv"
    rows = [row for row in csv.reader(file.open()) if row and not row[0].startswith("#")]
    return np.array(rows[1:], float)[:, [0, 2]]


def worst_energy(resolution, reynolds, scheme=None, **changes):
    """Largest deviation of the kinetic energy from the table, relative to its present value, until t = 5."""
    time, energy = energy_table(reynolds).T
    scheme = scheme or WeaklyCompressible(**(validation.PERIODIC_OPTIONS_3D | changes))
    run = taylor_green(resolution, reynolds, dimension=3, scheme=scheme)
    worst = 0.0
    for until in (1.0, 2.0, 3.0, 4.0, 5.0):
        run.advance(until)
        worst = max(worst, abs(kinetic_energy(run) / np.interp(until, time, energy) - 1))
    assert not bool(run.record.failed.any())
    return worst


@pytest.mark.slow
def test_taylor_green_3d_kinetic_energy():
    """Within the 3 % that the issue asks for, at Re 100 on 20^3 particles already: measured 1.6 %."""
    assert worst_energy(20, 100) < 0.025


def test_taylor_green_3d_kinetic_energy_by_projection():
    """Within 1.3 % at Re 100 on 20^3, in half of the other scheme's time."""
    assert worst_energy(20, 100, Projection(**validation.PERIODIC_PROJECTION_3D)) < 0.016


@pytest.mark.slow
@pytest.mark.parametrize("reynolds", [50, 100])
def test_taylor_green_3d_kinetic_energy_at_32(reynolds):
    """Within 1.5 %: measured 0.9 and 1.3 % (Re 50 and 100)."""
    assert worst_energy(32, reynolds) < 0.015


@pytest.mark.slow
def test_disorder_is_what_dissipates_in_space():
    """Without shifting a third of the energy is lost too early; without damping and diffusion of sound nothing changes.

    Measured at 24^3 with h = 1.6: 34 % without shifting, 10.4 and 10.4 % at strength 8 with bulk damping off or on.
    """
    weak = {"smoothing_ratio": 1.6, "shifting": 8.0}
    assert worst_energy(24, 100, smoothing_ratio=1.6, shifting=None) > 0.25
    damped, undamped = worst_energy(24, 100, **weak), worst_energy(24, 100, **weak, bulk_damping=None)
    assert abs(damped - undamped) < 0.01
