"""Order of the time steps, by regression over step sizes at fixed particles."""

import math

import numpy as np
import pytest
import torch

from torchsph import XSPH, Scene, Simulator, WeaklyCompressible
from torchsph.simulator.scene import Fluid
from torchsph.simulator.schemes.weakly_compressible import ORDERS
from torchsph.simulator.state.particles import Particles
from torchsph.simulator.stepping.time_schemes import TIME_SCHEMES

STEPS = (32, 64, 128)


def end_state(order, steps, viscosity):
    """Positions and velocities of a slightly disordered vortex after a fixed time in ``steps`` steps."""
    scene = Scene(spacing=1 / 16, fluid=Fluid(1.0, viscosity), period=(1.0, 1.0), dimension=2)
    scheme = WeaklyCompressible(
        order=order,
        shifting=None,
        artificial_viscosity=None,
        bulk_damping=None,
        density_diffusion=None,
        sound_speed=5.0,
        smoothing_ratio=1.5,
        pressure="sum",
        courant=5.0,
        steps_per_frame=steps,
    )
    axis = torch.arange(16, dtype=torch.float64) + 0.5
    place = torch.cartesian_prod(axis, axis)
    x, y = (2 * math.pi * place / 16).unbind(1)
    velocity = 0.5 * torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)
    ones, label = torch.ones_like(x), torch.zeros(256, dtype=torch.int64)
    place = place + 0.05 * torch.stack([torch.sin(x + y), torch.cos(x - y)], 1)
    simulator = Simulator(scene, scheme, dtype=torch.float64, backend="reference")
    run = simulator.resume(Particles(place, velocity, 0 * ones, ones, label, label, 1), 0.0)
    run.advance(0.05)
    assert int(run.record.steps) == steps
    return torch.cat([run.particles.position, run.particles.velocity], 1)


def observed(order, viscosity):
    """Order from the differences between successive refinements, which need no finest solution."""
    states = [end_state(order, n, viscosity) for n in STEPS]
    gaps = [float((a - b).norm()) for a, b in zip(states, states[1:], strict=False)]
    return -np.polyfit(np.log(STEPS[:-1]), np.log(gaps), 1)[0]


@pytest.mark.parametrize(
    ("order", "viscosity", "expected"),
    [
        ("symplectic", 0.0, 1),
        ("verlet", 0.0, 2),
        ("verlet", 0.05, 1),
        ("predictor_corrector", 0.0, 2),
        ("predictor_corrector", 0.05, 2),
    ],
)
def test_order_of_the_steps(order, viscosity, expected):
    """Verlet loses an order to viscous forces, as its documentation says; the predictor-corrector keeps it."""
    assert observed(order, viscosity) == pytest.approx(expected, abs=0.25)


def test_every_order_that_a_scheme_can_name_is_stepped():
    assert set(TIME_SCHEMES) == set(ORDERS)


def test_options_that_would_be_ignored_are_refused():
    with pytest.raises(ValueError, match="tensile must be positive and needs pressure='symmetric'"):
        WeaklyCompressible(tensile=0.2)
    with pytest.raises(ValueError, match="belongs to order 'thesis', got order 'verlet'"):
        WeaklyCompressible(xsph=XSPH(0.2, "velocity"), order="verlet")
    with pytest.raises(ValueError, match="Shepard filter needs order"):
        WeaklyCompressible(shepard_period=20, order="verlet")


def test_the_softening_of_the_viscous_term_is_compensated():
    """Over a lattice with a wide kernel the term acts on a shear wave as nu k^2 with the share divided out, 0.6 %."""
    from torchsph.pairs import MomentumTerms, PairState, Support, choose_backend
    from torchsph.pairs.smoothing_kernels import kernel
    from torchsph.simulator.stepping.terms import softened_share

    axis = torch.arange(96, dtype=torch.float64) + 0.5
    place = torch.cartesian_prod(axis, axis[:16])
    place[:, 1] = place[:, 1] - 8
    wave = 2 * math.pi / 96
    velocity = torch.stack([0 * place[:, 0], torch.sin(wave * place[:, 0])], 1)
    ones, label = torch.ones(len(place), dtype=torch.float64), torch.zeros(len(place), dtype=torch.int64)
    support = Support(kernel("wendland_c2"), 2.0, 2)
    engine = choose_backend("reference")
    period = torch.tensor([96.0, 16.0], dtype=torch.float64)
    pairs = engine.search(place, label, support.radius, period=period)
    state = PairState(place, velocity, ones, 0 * ones, 0 * ones, label)
    force = engine.momentum(pairs, state, support, MomentumTerms(None, laminar=1.0))[:, 1]
    acting = -float((force * velocity[:, 1]).sum() / velocity[:, 1].square().sum()) / wave**2
    share = softened_share(support.kernel, 2)
    assert acting < 0.99  # what the compensation is for
    assert acting / share == pytest.approx(1.0, abs=0.006)
