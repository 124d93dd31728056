"""Sigma points and unscented filters against the Kalman filter, the Riccati equation and chi^2 bands."""

import pytest
import torch
from scipy.linalg import solve_discrete_are

from torchsph.assimilation import (
    AssimilationError,
    ErrorSubspace,
    Observations,
    ReducedUnscented,
    Simplex,
    Symmetric,
    UnscentedFilter,
    chi2_band,
    draw_ensemble,
    draw_points,
    nees,
)

RULES = [Simplex(), Symmetric(), Symmetric(alpha=0.3, beta=2.0, kappa=1.0), Symmetric(alpha=1.4, kappa=3.0)]


def double(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def stable(size, seed=1):
    """A linear model with spectral radius 0.95, and noise modes."""
    matrix = double(size, size, seed=seed)
    return 0.95 * matrix / torch.linalg.eigvals(matrix).abs().max(), 0.3 * double(size, size, seed=seed + 1)


def kalman_step(mean, covariance, model, noise, operator, value, variance):
    mean, covariance = model @ mean, model @ covariance @ model.T + noise
    inner = operator @ covariance @ operator.T + torch.diag(variance)
    gain = covariance @ operator.T @ torch.linalg.inv(inner)
    return mean + gain @ (value - operator @ mean), covariance - gain @ operator @ covariance


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("rank", [1, 4])
def test_rules_have_the_moments_they_claim(rule, rank):
    weight, coordinate = rule.rule(rank)
    assert len(weight) == rule.size(rank) and rule.rank(len(weight)) == rank
    assert weight.sum() == pytest.approx(1)
    assert torch.allclose(weight @ coordinate, torch.zeros(rank).double(), atol=1e-14)
    unit = torch.eye(rank, dtype=torch.float64)
    assert torch.allclose(coordinate.T @ (weight.unsqueeze(-1) * coordinate), unit, atol=1e-13)
    subspace = ErrorSubspace(double(6), double(rank, 6, seed=1), 0.5 * unit)
    back = rule.gather(draw_points(subspace, rule))
    assert torch.allclose(back.mean, subspace.mean, atol=1e-12)
    assert torch.allclose(back.covariance(), subspace.covariance(), atol=1e-12)


@pytest.mark.parametrize("size", [3, 5, 9])
def test_drawn_ensembles_have_the_moments_exactly(size):
    subspace = ErrorSubspace(double(6), double(4, 6, seed=1), 0.5 * torch.eye(4, dtype=torch.float64))
    ensemble = draw_ensemble(subspace, size, torch.Generator().manual_seed(0))
    other = draw_ensemble(subspace, size, torch.Generator().manual_seed(1))
    assert torch.allclose(ensemble.mean(0), subspace.mean, atol=1e-12)
    assert torch.allclose(torch.cov(ensemble.T), subspace.truncated(size - 1).covariance(), atol=1e-12)
    assert (ensemble - other).abs().max() > 0.1


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_quadratic_of_a_gaussian_has_exact_mean_and_variance(alpha):
    """x ~ N(0, 1): x^2 has mean 1 and variance 2."""
    rule = Symmetric(alpha=alpha)
    subspace = ErrorSubspace(torch.zeros(1).double(), torch.ones(1, 1).double(), torch.ones(1, 1).double())
    square = rule.gather(draw_points(subspace, rule).square())
    assert square.mean.item() == pytest.approx(1, abs=1e-12)
    assert square.covariance().item() == pytest.approx(2, abs=1e-10)


@pytest.mark.parametrize("rule", RULES)
def test_unscented_is_the_kalman_filter(rule):
    model, noise = stable(4)
    operator, variance = double(3, 4, seed=5), torch.tensor([0.5, 1.0, 2.0]).double()
    filter_ = UnscentedFilter(points=rule)
    mean, covariance = double(4, seed=6), 2 * torch.eye(4, dtype=torch.float64)
    state = filter_.start(mean, covariance)
    for cycle in range(20):
        value = double(3, seed=100 + cycle)
        mean, covariance = kalman_step(mean, covariance, model, noise.T @ noise, operator, value, variance)
        state = filter_.predict(state, lambda x: x @ model.T, noise)
        update = filter_.update(state, lambda x: x @ operator.T, Observations(value, variance))
        state = update.state
        assert torch.allclose(state.mean, mean, atol=1e-10, rtol=0)
        assert torch.allclose(state.covariance(), covariance, atol=1e-10, rtol=0)


@pytest.mark.parametrize("rule", RULES)
def test_reduced_unscented_is_the_kalman_filter_in_its_subspace(rule):
    model, _ = stable(6)
    operator, variance = double(3, 6, seed=5), torch.tensor([0.5, 1.0, 2.0]).double()
    modes = double(2, 6, seed=7)
    mean, covariance = double(6, seed=6), modes.T @ modes
    start = ErrorSubspace(mean, modes, torch.eye(2, dtype=torch.float64))
    points = draw_points(start, rule)
    none = torch.zeros(6, 6).double()
    for cycle in range(20):
        value = double(3, seed=100 + cycle)
        mean, covariance = kalman_step(mean, covariance, model, none, operator, value, variance)
        points = points @ model.T
        analysis = ReducedUnscented(points=rule).analyse(points, points @ operator.T, Observations(value, variance))
        points = analysis.ensemble
        assert torch.allclose(analysis.mean, mean, atol=1e-10, rtol=0)
        assert torch.allclose(rule.gather(points).covariance(), covariance, atol=1e-10, rtol=0)
        assert torch.allclose(analysis.variance, covariance.diagonal(), atol=1e-10, rtol=0)


def test_reduced_unscented_keeps_the_variance_of_the_even_response():
    rule = Symmetric()
    start = ErrorSubspace(double(5), double(3, 5, seed=2), torch.eye(3, dtype=torch.float64))
    points = draw_points(start, rule)
    points = points + 0.3 * points.square()
    silent = Observations(torch.full((5,), torch.nan).double(), torch.ones(5).double())
    full = rule.gather(points).variance().sum()
    kept = ReducedUnscented(points=rule).analyse(points, points, silent).variance.sum()
    dropped = ReducedUnscented(points=rule, keep_variance=False).analyse(points, points, silent).variance.sum()
    assert kept.item() == pytest.approx(full.item(), rel=1e-12)
    assert dropped < 0.99 * full


def riccati_error(cycles: int) -> tuple[float, float]:
    """Float32 states: distance of the covariance from the Riccati equation's, and its smallest eigenvalue."""
    model, noise = stable(4)
    operator, variance = double(2, 4, seed=5), torch.tensor([1e-3, 1.0])
    filter_ = UnscentedFilter()
    state = filter_.start(torch.zeros(4), 100 * torch.eye(4))
    seen = Observations(torch.zeros(2), variance)
    lowest = float("inf")
    for _ in range(cycles):
        state = filter_.predict(state, lambda x: x @ model.float().T, noise)
        forecast = state.covariance()
        state = filter_.update(state, lambda x: x @ operator.float().T, seen).state
        value = torch.linalg.eigvalsh(state.covariance())
        lowest = min(lowest, (value[0] / value[-1]).item())
    exact = solve_discrete_are(model.T, operator.T, (noise.T @ noise), torch.diag(variance).double())
    error = (forecast - torch.as_tensor(exact)).norm() / torch.as_tensor(exact).norm()
    assert state.mean.dtype == torch.float32
    return error.item(), lowest


def test_float32_covariance_solves_the_riccati_equation():
    error, lowest = riccati_error(300)
    assert error < 1e-5
    assert lowest > 0


@pytest.mark.slow
def test_float32_covariance_stays_positive_for_ten_thousand_cycles():
    error, lowest = riccati_error(10_000)
    assert error < 1e-5
    assert lowest > 0


def monte_carlo(claimed: float, runs: int = 200, steps: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean NEES and NIS per step over `runs` experiments; observation variance is 1, the filter told
    `claimed`.
    """
    draw = torch.Generator().manual_seed(3)
    model, noise = stable(3)
    operator = double(2, 3, seed=5)
    filter_ = UnscentedFilter()
    truth = torch.randn(runs, 3, generator=draw, dtype=torch.float64)
    state = filter_.start(torch.zeros(runs, 3).double(), torch.eye(3).double().expand(runs, 3, 3))
    errors, innovations = [], []
    for _ in range(steps):
        truth = truth @ model.T + torch.randn(runs, 3, generator=draw, dtype=torch.float64) @ noise
        value = truth @ operator.T + torch.randn(runs, 2, generator=draw, dtype=torch.float64)
        state = filter_.predict(state, lambda x: x @ model.T, noise)
        seen = Observations(value, torch.full((2,), claimed).double())
        update = filter_.update(state, lambda x: x @ operator.T, seen)
        state = update.state
        errors.append(nees(state.mean - truth, state.covariance()).mean())
        innovations.append(update.nis.mean())
    return torch.stack(errors), torch.stack(innovations)


def test_nees_and_nis_lie_in_their_bands():
    errors, innovations = monte_carlo(1.0)
    for values, size in ((errors, 3), (innovations, 2)):
        low, high = chi2_band(200 * size)
        inside = ((values > low * size) & (values < high * size)).double().mean()
        assert inside >= 0.88  # of 40 steps; 0.95 expected, 0.88 is two standard deviations lower
    # Innovations of a right filter are white, so their total has a band of its own.
    low, high = chi2_band(200 * 2 * 40)
    assert low < innovations.mean() / 2 < high


def test_bands_notice_wrong_errors():
    errors, innovations = monte_carlo(0.3)
    assert (errors > chi2_band(200 * 3)[1] * 3).double().mean() > 0.9
    assert (innovations > chi2_band(200 * 2)[1] * 2).double().mean() > 0.9


def test_missing_observations_and_gross_errors():
    operator = double(3, 4, seed=5)
    state = UnscentedFilter().start(double(4), torch.eye(4).double())
    value = operator @ state.mean + torch.tensor([0.1, 1e4, torch.nan]).double()
    filter_ = UnscentedFilter(gross_error=5.0)
    update = filter_.update(state, lambda x: x @ operator.T, Observations(value, torch.ones(3).double()))
    alone = filter_.update(state, lambda x: x @ operator[:1].T, Observations(value[:1], torch.ones(1).double()))
    assert update.counts() == {"used": 1, "missing": 1, "gross_error": 1}
    assert torch.allclose(update.state.mean, alone.state.mean, atol=1e-12)
    assert torch.allclose(update.nis, alone.nis)


def test_bad_options_are_named():
    with pytest.raises(AssimilationError, match="could become negative"):
        Symmetric(alpha=2.0)
    with pytest.raises(AssimilationError, match="2 r \\+ 1"):
        Symmetric().rank(4)
    with pytest.raises(AssimilationError, match="negative eigenvalues"):
        UnscentedFilter().start(torch.zeros(2), -torch.eye(2))
    with pytest.raises(AssimilationError, match="rotation"):
        ReducedUnscented(rotation=True)
