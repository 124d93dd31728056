"""Order of the time steps, by regression over step sizes at fixed particles."""

import math

import numpy as np
import pytest
import torch

from torchsph import XSPH, Scene, Simulator, preset
from torchsph.particles import Particles
from torchsph.scene import Fluid

STEPS = (32, 64, 128)


def end_state(order, steps, viscosity):
    """Positions and velocities of a slightly disordered vortex after a fixed time in ``steps`` steps."""
    scene = Scene(spacing=1 / 16, fluid=Fluid(1.0, viscosity), period=(1.0, 1.0), dimension=2)
    scheme = preset(
        "default", order=order, shifting=None, artificial_viscosity=None, bulk_damping=None, density_diffusion=None,
        sound_speed=5.0, smoothing_ratio=1.5, pressure="sum", courant=5.0, steps_per_frame=steps,
    )  # fmt: skip
    axis = torch.arange(16, dtype=torch.float64) + 0.5
    place = torch.cartesian_prod(axis, axis)
    x, y = (2 * math.pi * place / 16).unbind(1)
    velocity = 0.5 * torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1)
    one, label = torch.ones_like(x), torch.zeros(256, dtype=torch.int64)
    place = place + 0.05 * torch.stack([torch.sin(x + y), torch.cos(x - y)], 1)
    simulator = Simulator(scene, scheme, dtype=torch.float64, backend="reference")
    run = simulator.resume(Particles(place, velocity, 0 * one, one, label, label, 1), 0.0)
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
    [("symplectic", 0.0, 1), ("verlet", 0.0, 2), ("verlet", 0.05, 1), ("predictor_corrector", 0.0, 2),
     ("predictor_corrector", 0.05, 2)],
)  # fmt: skip
def test_order_of_the_steps(order, viscosity, expected):
    """Verlet loses an order to viscous forces, as its documentation says; the predictor-corrector keeps it."""
    assert observed(order, viscosity) == pytest.approx(expected, abs=0.25)


def test_options_that_would_be_ignored_are_refused():
    with pytest.raises(ValueError, match="tensile must be positive and needs pressure='symmetric'"):
        preset("default", tensile=0.2)
    with pytest.raises(ValueError, match="belongs to order 'thesis', got order 'verlet'"):
        preset("default", xsph=XSPH(0.2, "velocity"), order="verlet")
    with pytest.raises(ValueError, match="Shepard filter needs order"):
        preset("default", shepard_period=20, order="verlet")
