"""Posterior variances against the dense inverse, and calibrated on simulated data."""

import pytest
import torch
from regularize_cases import blocks_of, smoother

from regularize import BlockFactor, InvalidInput, Posterior, PreparedSystem, System, solve_direct
from regularize.smoothing.knot_grid import knots_for
from regularize.smoothing.row_blocks import build_system
from regularize.smoothing.samples import FitData

SMALL = {"automatic": None, "robust": None}


@pytest.mark.parametrize("axes,degree", [(2, 3), (3, 2), (2, 1)])
def test_variance_equals_dense_inverse(axes, degree):
    knots, blocks = blocks_of(axes, degree)
    system = System(knots, axes, list(blocks.values()), 0.3)
    eye = torch.eye(system.unknowns, dtype=torch.float64)
    a = torch.stack([system.matvec(column) for column in eye], dim=1)
    inverse = torch.linalg.inv(a.T @ a + 0.09 * eye).view(knots.nodes, axes, knots.nodes, axes)
    factor = solve_direct(PreparedSystem(system))[1]
    points = torch.rand(30, axes, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    points = points * torch.tensor(knots.spacing).double() * torch.tensor(knots.cells)
    points = points + torch.tensor(knots.origin).double()
    cell, t = knots.locate(points)
    points = points[torch.isin(knots.cell_number(cell), system.cells())]
    cell, t = knots.locate(points)
    basis = torch.zeros(len(points), knots.nodes, dtype=torch.float64)
    basis.scatter_(1, knots.local_nodes(cell), knots.stencil(t))
    expected = torch.einsum("ni,icjc,nj->nc", basis, inverse, basis)
    assert len(points) > 10
    for either in (factor, BlockFactor(PreparedSystem(system).band(), factor.ordering)):
        assert torch.allclose(Posterior(either, 4.0, axes).variance(points), expected / 4.0, rtol=1e-9)


def simulated(options, points, noise, count, generator):
    """(exact, measured) velocities of ``count`` fields drawn from the prior that ``options`` stand for."""
    data = FitData.checked(points, torch.zeros_like(points), None, None, None, None, 1.0)
    knots = knots_for(data, options)
    blocks = build_system(options, knots, data)
    silent = blocks.blocks[0].with_weight(0.0)
    prior = PreparedSystem(System(knots, 3, [silent, *blocks.blocks[1:]], blocks.damping))
    drawn_from = prior.factor()
    for _ in range(count):
        truth = prior.expand(drawn_from.sample(len(points) / noise**2, generator))
        cell, t = knots.locate(points)
        exact = torch.einsum("nl,nlc->nc", knots.stencil(t), truth[knots.local_nodes(cell)])
        yield exact, exact + noise * torch.randn(exact.shape, generator=generator, dtype=torch.float64)


def test_z_scores_on_data_simulated_from_the_model():
    """Fields drawn from the prior, noisy samples of them: (fit - truth) / std has standard deviation 1."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(800, 3, generator=generator, dtype=torch.float64) * 15e-3
    options = smoother(divergence=5e-3, curvature=1.5e-3, damping=0.05, wall=None, no_slip=None, **SMALL)
    z = []
    for exact, measured in simulated(options, points, 0.2, 6, generator):
        field = options.fit(points, measured, uncertainty=True)
        z.append((field(points) - exact) / field.std(points))
    assert float(torch.cat(z).std()) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("divergence", [1e-3, 4e-3])
def test_the_likelihood_recovers_noise_curvature_and_divergence_of_simulated_data(divergence):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 3, generator=generator, dtype=torch.float64) * 17e-3
    same = {"damping": 0.05, "wall": None, "no_slip": None, "robust": None}
    truth = smoother(divergence=divergence, curvature=0.6e-3, automatic=None, **same)
    ((_, measured),) = simulated(truth, points, 0.05, 1, generator)
    blind = smoother(choose_divergence=True, search_knots=1.0, rounds=30, **same)  # starts from the defaults
    choice = blind.fit(points, measured).choice
    assert choice.settled and choice.noise == pytest.approx((0.05,) * 3, rel=0.1)
    assert choice.curvature == pytest.approx(0.6e-3, rel=0.05)
    assert choice.divergence == pytest.approx(divergence, rel=0.3)


def test_z_scores_with_everything_chosen_from_the_data():
    """A smooth divergence-free flow, white noise of unlike components, outliers, no parameter told."""
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(3000, 3, generator=generator, dtype=torch.float64) * 20e-3
    x, y, z = (150 * points).unbind(1)
    exact = torch.stack([torch.sin(y) + torch.cos(z), torch.sin(z + 1), torch.cos(x) + torch.sin(y)], dim=1)
    level = torch.tensor([0.3, 0.3, 0.1], dtype=torch.float64)
    measured = exact + level * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    hops = torch.rand(3000, generator=generator) < 0.02
    measured[hops] += 5.0
    field = smoother().fit(points, measured, uncertainty=True)
    assert torch.allclose(torch.tensor(field.choice.noise).double(), level, rtol=0.15)
    assert float(field.choice.robust[hops].max()) == 0 and float(field.choice.robust[~hops].mean()) > 0.8
    inner = ((points > 3e-3) & (points < 17e-3)).all(1)
    score = ((field(points) - exact) / field.std(points))[inner]
    # one smooth flow is smoother than the prior's typical draw: the deviations err on the safe side
    assert 0.6 < float(score.square().mean().sqrt()) < 1.1


def test_z_scores_of_a_blurred_measurement_need_its_blur():
    """Waves that a Gaussian resolution cell damps by exp(-k^2 s^2 / 2): the samples agree on a wrong field."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=generator, dtype=torch.float64) * 15e-3
    wave = 2 * torch.pi / 14e-3
    x, y, z = (wave * points).unbind(1)
    exact = torch.stack([torch.sin(y), torch.cos(z), torch.sin(x)], dim=1)
    blur = 4e-3
    damped = exact * float(torch.exp(torch.tensor(-0.5 * (wave * blur / 2.3548) ** 2)))
    noise = 0.1 * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    field = smoother(robust=None).fit(points, damped + noise, uncertainty=True)
    inner = ((points > 2e-3) & (points < 13e-3)).all(1)
    off = (field(points) - exact)[inner]
    assert float((off / field.std(points)[inner]).square().mean().sqrt()) > 5
    assert 0.7 < float((off / field.std(points, blur=blur)[inner]).square().mean().sqrt()) < 1.5


def test_laplacian_equals_autodiff():
    where = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1e-2
    field, points = smoother(knots=4e-3, **SMALL).fit(where, torch.sin(300 * where)), where.clone().requires_grad_()
    total = torch.zeros(200, 3, dtype=torch.float64)
    for k in range(3):
        (first,) = torch.autograd.grad(field(points)[:, k].sum(), points, create_graph=True)
        for j in range(3):
            total[:, k] += torch.autograd.grad(first[:, j].sum(), points, retain_graph=True)[0][:, j]
    assert torch.allclose(field.laplacian(where), total, rtol=1e-6, atol=1e-6 * float(total.abs().max()))


def test_std_needs_a_posterior_and_is_masked():
    points = torch.rand(100, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 1e-2
    options = smoother(**SMALL)
    with pytest.raises(InvalidInput, match="uncertainty"):
        options.fit(points, points).std(points)
    field = options.fit(points, points, uncertainty=True)
    assert torch.isnan(field.std(points + 1.0)).all() and (field.std(points) >= 0).all()
    with pytest.raises(InvalidInput, match="blur"):
        field.std(points, blur=-1e-3)
    with pytest.raises(InvalidInput, match="uncertainty"):
        smoother(solver="lsqr", divergence=None, **SMALL).fit(points, points, uncertainty=True)


def test_cross_validation_finds_the_best_curvature_on_white_noise():
    generator = torch.Generator().manual_seed(2)
    points = torch.rand(3000, 2, generator=generator, dtype=torch.float64) * 40e-3
    x, y = (300 * points).unbind(1)
    exact = torch.stack([torch.sin(y) + torch.cos(2 * y), torch.sin(2 * x)], dim=1)
    measured = exact + 0.5 * torch.randn(3000, 2, generator=generator, dtype=torch.float64)
    options = smoother(knots=2e-3, automatic="gcv", robust=None, search_knots=1.0)
    chosen = options.fit(points, measured)
    assert chosen.choice.noise == pytest.approx((0.5, 0.5), rel=0.05)

    def error(length):
        return float((options.fixed(curvature=length).fit(points, measured)(points) - exact).norm())

    best = min(error(chosen.choice.curvature * 2.0**k) for k in (-2, -1, -0.5, 0, 0.5, 1, 2))
    assert error(chosen.choice.curvature) < 1.05 * best
    measured[:60] += 20.0
    robust = smoother(knots=2e-3, automatic="gcv").fit(points, measured)
    assert float(robust.choice.robust[:60].max()) == 0
    assert float((robust(points) - exact).norm()) < 1.3 * best
