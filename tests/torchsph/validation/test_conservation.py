"""What the scheme conserves: both momenta at round-off, the energy's budget, indifference to the pressure's level."""

import math
from dataclasses import replace

import pytest
import torch

from torchsph import Scene, Simulator, WeaklyCompressible, preset
from torchsph.pairs import choose_backend
from torchsph.pairs.interface import MomentumTerms, PairState, Support
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.scene import Fluid
from torchsph.simulator.state.particles import Particles
from torchsph.validation import exact_flows as validation
from torchsph.validation.runs import channel, channel_error, kinetic_energy, taylor_green

FORMS = ("symmetric", "sum", "switched", "difference")


def rotating_patch(viscosity, dtype=torch.float64, **changes):
    """A square of 16^2 particles that starts as a rigid rotation, without walls, moving along as a whole."""
    count, omega = 16, 2.0
    scene = Scene(spacing=0.02, fluid=Fluid(1.0, viscosity), dimension=2)
    axis = torch.arange(count, dtype=dtype) + 0.5
    position = torch.cartesian_prod(axis, axis)
    arm = (position - count / 2) * scene.spacing
    velocity = omega * torch.stack([-arm[:, 1], arm[:, 0]], 1) + torch.tensor([0.3, -0.2], dtype=dtype)
    ones, label = torch.ones_like(position[:, 0]), torch.zeros(len(position), dtype=torch.int64)
    start = Particles(position, velocity, 0 * ones, ones, label, label, 1)
    scheme = WeaklyCompressible(**(validation.FREE_SURFACE_OPTIONS | changes))
    return Simulator(scene, scheme, dtype=dtype).resume(start, 0.0)


def momenta(run):
    """Linear (2,) and angular momentum about the centre of mass, per mass, and the mean speed."""
    x, v = run.particles.position.double() * run.simulator.scene.spacing, run.particles.velocity.double()
    x, own = x - x.mean(0), v - v.mean(0)
    return v.mean(0), float((x[:, 0] * own[:, 1] - x[:, 1] * own[:, 0]).mean()), float(v.norm(dim=1).mean())


@pytest.mark.parametrize("order", ["symplectic", "verlet", "predictor_corrector"])
@pytest.mark.parametrize(("dtype", "round_off"), [(torch.float32, 1e-5), (torch.float64, 1e-13)])
def test_both_momenta_of_a_free_patch_stand_at_round_off(order, dtype, round_off):
    """Pressure and artificial viscosity act along the line between two particles, so that no torque is left over."""
    run = rotating_patch(0.0, dtype, order=order)
    linear, angular, speed = momenta(run)
    run.advance(0.2)
    after, turned, _ = momenta(run)
    assert float((after - linear).norm()) < round_off * speed
    assert turned == pytest.approx(angular, rel=10 * round_off)


def test_laminar_viscosity_turns_little():
    """Morris's viscous force is along the velocities' difference: linear momentum stands, angular drifts.

    A fluid in rigid rotation feels no viscosity, but kernels cut off by the free surface do: measured 4 % in 0.4
    radian at Re = omega L^2 / nu = 100.
    """
    run = rotating_patch(0.002)
    linear, angular, speed = momenta(run)
    run.advance(0.2)
    after, turned, _ = momenta(run)
    assert float((after - linear).norm()) < 1e-13 * speed
    assert 0.95 * angular < turned <= angular


@pytest.mark.parametrize("dimension", [2, 3])
def test_linear_momentum_of_a_periodic_vortex_stands_at_round_off(dimension):
    run = taylor_green(20 if dimension == 2 else 16, dimension=dimension)
    speed = float(run.particles.velocity.norm(dim=1).mean())
    run.advance(0.2)
    assert float(run.particles.velocity.double().mean(0).norm()) < 1e-6 * speed


def compression_energy(run):
    """Energy per mass of the compressed fluid: integral of p / rho^2 over the density, for p = c^2 rho0 d."""
    d = run.particles.deviation.double()
    return run.simulator.scheme.sound_speed**2 * float((torch.log1p(d) - d / (1 + d)).mean())


def viscous_power(run):
    """Power per mass of the laminar forces between the particles, by their sums alone."""
    scene, scheme, p = run.simulator.scene, run.simulator.scheme, run.particles
    support = Support(kernel(scheme.kernel), scheme.smoothing_ratio, p.position.shape[1])
    acting = choose_backend("reference")
    pairs = acting.search(p.position, p.member, support.radius, period=run.domain.period)
    nu = scene.fluid.kinematic_viscosity / run.units.kinematic_viscosity
    state = PairState(p.position, p.velocity, p.mass, p.deviation, torch.zeros_like(p.deviation), p.member)
    force = acting.momentum(pairs, state, support, MomentumTerms(pressure=None, laminar=nu))
    return float((force * p.velocity).sum(1).mean()) / run.units.time


def test_energy_budget_of_a_vortex():
    """What a vortex loses is what viscosity takes; diffusion, damping of sound and shifting take the rest.

    Measured at 40^2 in half a second, when more than half of the energy is gone: viscous sums take 97.3 % of the loss,
    which is 1.0 % less than the exact one.
    """
    run = taylor_green(40)
    before = kinetic_energy(run) + compression_energy(run)
    times = [0.02 * k for k in range(26)]
    power = [viscous_power(run)]
    for until in times[1:]:
        run.advance(until)
        power.append(viscous_power(run))
    spent = -float(torch.trapezoid(torch.tensor(power), torch.tensor(times)))
    lost = before - kinetic_energy(run) - compression_energy(run)
    exact = 0.25 * (1 - math.exp(-16 * math.pi**2 * 0.01 * times[-1]))
    assert spent < lost < 1.04 * spent
    assert lost == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize("form", FORMS)
def test_only_the_difference_form_is_blind_to_the_level_of_the_pressure(form):
    """Forces of a constant pressure on uneven particles: none for "difference", and for "switched" below zero."""
    generator = torch.Generator().manual_seed(0)
    axis = torch.arange(12, dtype=torch.float64) + 0.5
    position = torch.cartesian_prod(axis, axis)
    position = position + 0.2 * torch.rand(position.shape, generator=generator, dtype=torch.float64)
    ones, member = torch.ones_like(position[:, 0]), torch.zeros(len(position), dtype=torch.int64)
    support = Support(kernel("wendland_c2"), 1.3, 2)
    period = torch.full((2,), 12.0, dtype=torch.float64)
    acting = choose_backend("auto")
    pairs = acting.search(position, member, support.radius, period=period)
    largest = {}
    for level in (-1.0, 1.0):
        state = PairState(position, torch.zeros_like(position), ones, 0 * ones, level * ones, member)
        force = acting.momentum(pairs, state, support, MomentumTerms(pressure=form))
        largest[level] = float(force.norm(dim=1).max())
    blind = [level for level in largest if largest[level] < 1e-13]
    assert blind == {"difference": [-1.0, 1.0], "switched": [-1.0]}.get(form, [])
    assert all(largest[level] > 0.01 for level in largest if level not in blind)


def test_a_background_pressure_changes_nothing_in_the_default_preset():
    """Bit for bit, where the thesis's symmetric form feels it: a pressure known up to a constant needs no care."""
    runs = {}
    for form in ("switched", "symmetric"):
        for level in (0.0, 0.5):
            scheme = replace(preset("weakly_compressible"), pressure=form, background_pressure=level)
            run = taylor_green(20, scheme=scheme)
            run.advance(0.1)
            runs[form, level] = run.particles.velocity
    assert torch.equal(runs["switched", 0.0], runs["switched", 0.5])
    assert not torch.equal(runs["symmetric", 0.0], runs["symmetric", 0.5])


@pytest.mark.parametrize("level", [-1.0, 1.0])
def test_a_channel_flows_alike_under_pressure_and_under_suction(level):
    """The fluid itself under a constant pressure of rho U^2 or its opposite, in the default's pressure form.

    The bound is that of the flow without it (test_validation_channel): measured 0.12 and 0.06 %, without 0.13 %.
    """
    run = channel("poiseuille", 20)
    sound = run.simulator.scheme.sound_speed
    run.particles = run.particles.changed(deviation=run.particles.deviation + level / sound**2)
    run.advance(0.5)
    assert channel_error(run) < 0.002
