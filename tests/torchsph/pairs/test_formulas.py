"""The reference backend against its formulas written out particle by particle in NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from pair_cases import disordered, support

from torchsph.pairs import MomentumTerms, RateTerms, ReferenceBackend

REFERENCE = ReferenceBackend()


class Dense:
    """All pairs of a few particles: gap[a, b] = x_a - x_b, Wendland C2 values and gradients by hand."""

    def __init__(self, state, length: float) -> None:
        x = state.position.numpy()
        self.count, self.dimension = x.shape
        self.v, self.m = state.velocity.numpy(), state.mass.numpy()
        self.rho = 1.0 + state.deviation.numpy()
        self.p, self.volume = state.pressure.numpy(), self.m / self.rho
        self.gap = x[:, None] - x[None]
        self.r = np.sqrt((self.gap**2).sum(2))
        q, h = self.r / length, length
        sigma = {2: 7 / (4 * np.pi), 3: 21 / (16 * np.pi)}[self.dimension] / h**self.dimension
        inside = q < 2
        self.w = sigma * (1 - q / 2) ** 4 * (1 + 2 * q) * inside
        slope = sigma * (-5 * q * (1 - q / 2) ** 3) / h * inside
        self.h = h
        direction = self.gap / np.where(self.r > 0, self.r, 1)[:, :, None]
        self.gradient = slope[:, :, None] * direction
        self.jump = self.v[:, None] - self.v[None]

    def each(self, pair) -> np.ndarray:
        """sum over b of pair(a, b), row a; b = a included."""
        return np.array([sum(pair(a, b) for b in range(self.count)) for a in range(self.count)])


@pytest.fixture(params=[2, 3])
def problem(request):
    state = disordered(5 if request.param == 2 else 3, request.param)
    choice = support("wendland_c2", request.param, 1.1)
    return state, choice, REFERENCE.search(state.position, state.member, choice.radius), Dense(state, 1.1)


def close(got, wanted):
    np.testing.assert_allclose(got.numpy(), wanted, rtol=1e-11, atol=1e-12)


def test_first_pass(problem):
    state, choice, pairs, d = problem
    got = REFERENCE.rates(pairs, state, choice, RateTerms("volume", True, True, True, True, True))
    jump, grad, v, m, rho, w = d.jump, d.gradient, d.volume, d.m, d.rho, d.w
    close(got.divergence, d.each(lambda a, b: -v[b] * jump[a, b] @ grad[a, b]))

    def spreading(a, b):
        if a == b:
            return 0.0
        return 2 * v[b] * (rho[b] - rho[a]) * (-d.gap[a, b]) @ grad[a, b] / d.r[a, b] ** 2

    close(got.diffusion, d.each(spreading))
    close(got.concentration, d.each(lambda a, b: v[b] * grad[a, b]))
    close(got.xsph, d.each(lambda a, b: -2 * m[b] / (rho[a] + rho[b]) * jump[a, b] * w[a, b]))
    close(got.shepard_volume, d.each(lambda a, b: v[b] * w[a, b]))
    close(got.shepard_mass, d.each(lambda a, b: m[b] * w[a, b]))
    close(got.renormalisation, d.each(lambda a, b: v[b] * np.outer(-d.gap[a, b], grad[a, b])))
    by_mass = REFERENCE.rates(pairs, state, choice, RateTerms("mass"))
    close(by_mass.divergence, d.each(lambda a, b: -m[b] * jump[a, b] @ grad[a, b]))


def test_pressure_forms(problem):
    state, choice, pairs, d = problem
    m, rho, p, grad = d.m, d.rho, d.p, d.gradient
    forms = {
        "symmetric": lambda a, b: -m[b] * (p[a] / rho[a] ** 2 + p[b] / rho[b] ** 2) * grad[a, b],
        "sum": lambda a, b: -m[b] * (p[a] + p[b]) / (rho[a] * rho[b]) * grad[a, b],
        "switched": lambda a, b: -m[b] * (abs(p[a]) + p[b]) / (rho[a] * rho[b]) * grad[a, b],
        "difference": lambda a, b: -m[b] * (p[b] - p[a]) / (rho[a] * rho[b]) * grad[a, b],
    }
    for name, pair in forms.items():
        close(REFERENCE.momentum(pairs, state, choice, MomentumTerms(name)), d.each(pair))


def test_viscosities_and_tension(problem):
    state, choice, pairs, d = problem
    m, rho, grad, gap, h = d.m, d.rho, d.gradient, d.gap, d.h

    def artificial(a, b):
        approach = min(d.jump[a, b] @ gap[a, b], 0.0)
        pi = -0.3 * h * approach / (d.r[a, b] ** 2 + 0.01 * h * h) / (0.5 * (rho[a] + rho[b]))
        return -m[b] * pi * grad[a, b]

    def laminar(a, b):
        # Morris, Fox & Zhu 1997 eq. 22 with mu = nu rho on each side
        weight = m[b] * 0.2 * (rho[a] + rho[b]) / (rho[a] * rho[b])
        return weight * gap[a, b] @ grad[a, b] / (d.r[a, b] ** 2 + 0.01 * h * h) * d.jump[a, b]

    near = {2: 7 / (4 * np.pi), 3: 21 / (16 * np.pi)}[d.dimension] / h**d.dimension
    near *= (1 - 0.5 / h) ** 4 * (1 + 2 / h)

    def tension(a, b):
        s = np.array([abs(d.p[i]) / rho[i] ** 2 for i in (a, b)])
        plain = d.p[a] / rho[a] ** 2 + d.p[b] / rho[b] ** 2
        return -m[b] * (plain + 0.2 * s.sum() * (d.w[a, b] / near) ** 4) * grad[a, b]

    close(REFERENCE.momentum(pairs, state, choice, MomentumTerms(None, artificial=0.3)), d.each(artificial))
    close(REFERENCE.momentum(pairs, state, choice, MomentumTerms(None, laminar=0.2)), d.each(laminar))
    terms = MomentumTerms("symmetric", tensile=0.2, tensile_distance=1.0)
    close(REFERENCE.momentum(pairs, state, choice, terms), d.each(tension))


def test_laplacian(problem):
    state, choice, pairs, d = problem

    def weight(a, b):
        return -2 * d.volume[b] * d.gap[a, b] @ d.gradient[a, b] / (d.r[a, b] ** 2 + 0.01 * d.h**2)

    got, diagonal = REFERENCE.laplacian(pairs, state, choice, state.pressure)
    close(got, d.each(lambda a, b: weight(a, b) * (d.p[a] - d.p[b])))
    close(diagonal, d.each(weight))


def test_moments_of_an_interpolation(problem):
    state, choice, _, d = problem
    fields = state.velocity
    got = REFERENCE.interpolate(state.position, state.member, fields, choice, state.position, state.member)
    s = -d.gap
    close(got.count, (d.w > 0).sum(1))
    close(got.value, d.each(lambda a, b: d.w[a, b]))
    close(got.first, d.each(lambda a, b: d.w[a, b] * s[a, b]))
    close(got.second, d.each(lambda a, b: d.w[a, b] * np.outer(s[a, b], s[a, b])))
    close(got.field, d.each(lambda a, b: d.w[a, b] * d.v[b]))
    close(got.field_first, d.each(lambda a, b: d.w[a, b] * np.outer(s[a, b], d.v[b])))


def test_moments_of_a_weighted_interpolation(problem):
    """A weight multiplies the particle's kernel in every moment; weightless particles are not counted."""
    state, choice, _, d = problem
    weight = (state.mass - 1.03).clamp_min(0.0)
    got = REFERENCE.interpolate(
        state.position, state.member, state.velocity, choice, state.position, state.member, weight=weight
    )
    s, w = -d.gap, d.w * weight.numpy()
    close(got.count, (w > 0).sum(1))
    close(got.value, d.each(lambda a, b: w[a, b]))
    close(got.second, d.each(lambda a, b: w[a, b] * np.outer(s[a, b], s[a, b])))
    close(got.field, d.each(lambda a, b: w[a, b] * d.v[b]))
    close(got.field_first, d.each(lambda a, b: w[a, b] * np.outer(s[a, b], d.v[b])))


def test_corrections(problem):
    state, choice, pairs, d = problem
    terms = RateTerms(None, gradient=True, corrected_diffusion=True, moments=True)
    got = REFERENCE.rates(pairs, state, choice, terms)
    v, rho, grad, s, slope = d.volume, d.rho, d.gradient, -d.gap, state.slope.numpy()
    close(got.gradient, d.each(lambda a, b: v[b] * (rho[b] - rho[a]) * grad[a, b]))

    def spreading(a, b):
        if a == b:
            return 0.0
        rise = rho[b] - rho[a] - 0.5 * (slope[a] + slope[b]) @ s[a, b]
        return 2 * v[b] * rise * s[a, b] @ grad[a, b] / d.r[a, b] ** 2

    close(got.diffusion, d.each(spreading))
    close(got.moment_first, d.each(lambda a, b: v[b] * d.w[a, b] * s[a, b]))
    close(got.moment_second, d.each(lambda a, b: v[b] * d.w[a, b] * np.outer(s[a, b], s[a, b])))
    close(got.moment_mass, d.each(lambda a, b: d.m[b] * d.w[a, b] * s[a, b]))


@pytest.mark.parametrize("dimension", [2, 3])
def test_corrected_diffusion_leaves_a_linear_density_alone(dimension):
    rise = torch.tensor([0.003, -0.002, 0.001][:dimension], dtype=torch.float64)
    state = disordered(9, dimension)
    linear = state.position @ rise
    state = dataclasses.replace(state, deviation=linear)
    choice = support("wendland_c2", dimension)
    pairs = REFERENCE.search(state.position, state.member, choice.radius)
    sums = REFERENCE.rates(pairs, state, choice, RateTerms(None, renormalisation=True, gradient=True))
    slope = torch.linalg.solve(sums.renormalisation.transpose(1, 2), sums.gradient)
    np.testing.assert_allclose(slope.numpy(), np.tile(rise.numpy(), (len(slope), 1)), atol=1e-12)
    state = dataclasses.replace(state, slope=slope)
    plain = REFERENCE.rates(pairs, state, choice, RateTerms(None, diffusion=True)).diffusion
    corrected = REFERENCE.rates(pairs, state, choice, RateTerms(None, corrected_diffusion=True)).diffusion
    assert float(corrected.abs().max()) < 1e-10 * float(plain.abs().max())


@pytest.mark.parametrize("dimension", [2, 3])
def test_moments_reproduce_a_linear_density(dimension):
    state = disordered(9, dimension)
    rho = 1.0 + state.position @ torch.tensor([0.02, 0.01, 0.03][:dimension], dtype=torch.float64)
    state = dataclasses.replace(state, deviation=rho - 1.0, mass=rho * (0.5 + state.mass))
    choice = support("wendland_c2", dimension)
    pairs = REFERENCE.search(state.position, state.member, choice.radius)
    m = REFERENCE.rates(pairs, state, choice, RateTerms(None, shepard=True, moments=True))
    correction = -torch.linalg.solve(m.moment_second, m.moment_first)
    share = m.shepard_volume + (correction * m.moment_first).sum(1)
    density = (m.shepard_mass + (correction * m.moment_mass).sum(1)) / share
    np.testing.assert_allclose(density.numpy(), rho.numpy(), rtol=1e-11)


def test_smoothing_length_of_each_particle_is_symmetrised():
    state = disordered(6, 3)
    lengths = torch.linspace(0.9, 1.4, 216, dtype=torch.float64)
    choice = dataclasses.replace(support("cubic", 3), length=lengths, per_particle=True)
    pairs = REFERENCE.search(state.position, state.member, choice.radius)
    force = state.mass[:, None] * REFERENCE.momentum(pairs, state, choice, MomentumTerms("sum", 0.3))
    assert float(force.sum(0).abs().max()) < 1e-13 * float(force.abs().sum(0).max())
    both = state.position[:2] * 0 + torch.tensor([[0.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    two = dataclasses.replace(state, **{k: v[:2] for k, v in vars(state).items()} | {"position": both})
    choice = dataclasses.replace(choice, length=torch.tensor([1.0, 1.4], dtype=torch.float64))
    pairs = REFERENCE.search(both, two.member, choice.radius)
    got = REFERENCE.rates(pairs, two, choice, RateTerms(None, concentration=True)).concentration[0, 0]
    q = 1.0 / 1.2
    slope = (-3 * q + 2.25 * q * q) / (np.pi * 1.2**4)
    np.testing.assert_allclose(float(got), -float(two.volume[1]) * slope, rtol=1e-12)
