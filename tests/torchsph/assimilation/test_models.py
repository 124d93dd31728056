"""The small models against what is known of them exactly."""

import math

import pytest
import torch

from torchsph.assimilation.twins.models import LinearAdvection, Lorenz63, Lorenz96, runge_kutta


def test_runge_kutta_is_of_fourth_order():
    def turn(state):
        return torch.stack([state[1], -state[0]])

    errors = []
    for steps in (10, 20, 40):
        state = torch.tensor([1.0, 0.0], dtype=torch.float64)
        for _ in range(steps):
            state = runge_kutta(turn, state, 1 / steps)
        exact = torch.tensor([math.cos(1), -math.sin(1)], dtype=torch.float64)
        errors.append((state - exact).norm())
    orders = [torch.log2(a / b).item() for a, b in zip(errors, errors[1:], strict=False)]
    assert all(order == pytest.approx(4, abs=0.1) for order in orders)


def test_lorenz63_fixed_points():
    model = Lorenz63()
    arm = (model.beta * (model.rho - 1)) ** 0.5
    points = [[0, 0, 0], [arm, arm, model.rho - 1], [-arm, -arm, model.rho - 1]]
    fixed = torch.tensor(points, dtype=torch.float64)
    assert model.rate(fixed).abs().max() < 1e-12


def test_lorenz96_conserves_energy_but_for_friction_and_forcing():
    state = torch.randn(3, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    model = Lorenz96()
    power = (state * (model.rate(state) + state - model.forcing)).sum(-1)
    assert power.abs().max() < 1e-12
    rest = torch.full((40,), model.forcing).double()
    assert model.rate(rest).abs().max() == 0
    # Lorenz 1996, eq. 1, written out for one site.
    x = state[0]
    assert model.rate(x)[5] == pytest.approx(((x[6] - x[3]) * x[4] - x[5] + 8).item(), abs=1e-13)


def test_advection_transports_and_reaches_its_stationary_variance():
    quiet = LinearAdvection(size=60, steps=3, damping=0.9, forcing=0.0)
    state = torch.randn(2, 60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    moved = quiet(state, torch.Generator().manual_seed(0))
    assert torch.allclose(moved, 0.9**3 * state.roll(-3, -1), atol=1e-15)
    model = LinearAdvection(size=200, steps=400, damping=0.9)
    assert model.modes().square().sum(0).mean() == pytest.approx(model.forcing)
    final = model(torch.zeros(40, 200).double(), torch.Generator().manual_seed(1))
    assert final.var(0).mean().item() == pytest.approx(model.forcing / (1 - 0.81), rel=0.1)
