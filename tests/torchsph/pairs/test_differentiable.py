"""Derivatives of the pair sums and of the pressure equation, checked by differences in double precision."""

from __future__ import annotations

import pytest
import torch

from torchsph.pairs import MomentumTerms, PairState, RateTerms, choose_backend
from torchsph.pairs.backends.differentiable import DifferentiableBackend
from torchsph.pairs.interface import Support
from torchsph.pairs.smoothing_kernels import kernel

SUPPORT = Support(kernel("wendland_c2"), 1.2, 2)
BACKEND = DifferentiableBackend(choose_backend("auto"))


def arrays(members=1, side=5):
    """A disordered square of particles: position, velocity, mass, deviation, pressure; and members."""
    draw = torch.Generator().manual_seed(0)
    axis = torch.arange(side, dtype=torch.float64)
    place = torch.cartesian_prod(axis, axis).repeat(members, 1)
    place = place + 0.3 * torch.rand(place.shape, generator=draw, dtype=torch.float64)
    velocity, mass, deviation, pressure = (
        torch.rand((len(place), *shape), generator=draw, dtype=torch.float64) for shape in ((2,), (), (), ())
    )
    member = torch.arange(members).repeat_interleave(side * side)
    tensors = [place, velocity, 1.0 + 0.1 * mass, 0.02 * deviation, pressure]
    return [tensor.requires_grad_() for tensor in tensors], member


def state(values, member):
    position, velocity, mass, deviation, pressure = values
    return PairState(position, velocity, mass, deviation, pressure, member)


def searched(position, member):
    return BACKEND.search(position, member, SUPPORT.radius, margin=0.1)


def test_rates():
    terms = RateTerms("volume", diffusion=True, concentration=True, xsph=True, shepard=True, gradient=True)
    values, member = arrays()
    names = ("divergence", "diffusion", "concentration", "xsph", "shepard_volume", "shepard_mass", "gradient")

    def sums(*given):
        found = BACKEND.rates(searched(given[0], member), state(given, member), SUPPORT, terms)
        return tuple(getattr(found, name) for name in names)

    assert torch.autograd.gradcheck(sums, values, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("form", ["symmetric", "switched", "difference"])
def test_momentum_with_coefficients_of_each_member(form):
    values, member = arrays(members=2, side=4)
    laminar = torch.tensor([0.1, 0.3], dtype=torch.float64, requires_grad=True)
    artificial = torch.tensor([0.2, 0.1], dtype=torch.float64, requires_grad=True)

    def sums(*given):
        terms = MomentumTerms(form, artificial=given[5], laminar=given[6])
        return BACKEND.momentum(searched(given[0], member), state(given[:5], member), SUPPORT, terms)

    assert torch.autograd.gradcheck(sums, (*values, artificial, laminar), eps=1e-6, atol=1e-6)


def test_moments_around_query_points():
    (position, velocity, mass, _, _), member = arrays()
    query = (torch.rand((6, 2), generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 4).requires_grad_()

    def sums(place, fields, at, weight):
        found = BACKEND.interpolate(
            place, member, fields, SUPPORT, at, torch.zeros(6, dtype=torch.int64), weight=weight
        )
        return found.value, found.first, found.second, found.field, found.field_first

    assert torch.autograd.gradcheck(sums, (position, velocity, query, mass), eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("bound", [False, True], ids=["up to a constant", "with a free surface"])
def test_the_pressure_equation_by_its_adjoint_and_not_by_its_iterations(bound):
    values, member = arrays()
    values[3] = torch.zeros_like(values[3])  # the operator is symmetric in an incompressible fluid
    free = torch.ones(len(member), dtype=torch.bool)
    free[:3] = not bound
    source = torch.rand(len(member), generator=torch.Generator().manual_seed(4), dtype=torch.float64).requires_grad_()
    guess = torch.zeros_like(source)

    def slopes(position, mass, right):
        given = state([position, values[1].detach(), mass, values[3], values[4].detach()], member)
        found = BACKEND.poisson(
            searched(position, member),
            given,
            SUPPORT,
            right,
            guess,
            free=free,
            active=torch.ones_like(free),
            singular=torch.tensor([not bound]),
            tolerance=1e-12,
            iterations=500,
        )
        assert bool(found.converged.all())
        return found.values - (0.0 if bound else found.values.mean())

    inputs = (values[0], values[2], source)
    assert torch.autograd.gradcheck(slopes, inputs, eps=1e-5, atol=1e-5, rtol=1e-4, nondet_tol=1e-9)


def test_without_gradients_it_is_the_fast_backend():
    (*given,), member = arrays()
    plain = [value.detach() for value in given]
    fast = choose_backend("auto")
    wanted = fast.rates(fast.search(plain[0], member, SUPPORT.radius), state(plain, member), SUPPORT, RateTerms())
    for values in (plain, given):
        found = BACKEND.rates(
            BACKEND.search(values[0], member, SUPPORT.radius), state(values, member), SUPPORT, RateTerms()
        )
        assert torch.equal(found.divergence, wanted.divergence)
    assert BACKEND.name == fast.name and BACKEND.differentiable
