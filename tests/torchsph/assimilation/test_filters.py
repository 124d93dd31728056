"""Global ensemble filters against the Kalman filter, and what all filters promise."""

import pytest
import torch

from torchsph.assimilation import (
    ETKF,
    RTPS,
    AssimilationError,
    ErrorSubspace,
    Multiplicative,
    Observations,
    Reason,
    StochasticEnKF,
    random_rotation,
    zero_sum_basis,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def problem(members: int = 12, state: int = 7, count: int = 5, seed: int = 0):
    draw = generator(seed)
    ensemble = 3 + torch.randn(members, state, generator=draw, dtype=torch.float64)
    operator = torch.randn(count, state, generator=draw, dtype=torch.float64)
    value = torch.randn(count, generator=draw, dtype=torch.float64)
    variance = 0.2 + torch.rand(count, generator=draw, dtype=torch.float64)
    return ensemble, operator, Observations(value, variance)


def kalman(mean, covariance, operator, value, variance):
    """Textbook Kalman update, dense (Kalman 1960)."""
    inner = operator @ covariance @ operator.T + torch.diag(variance)
    gain = covariance @ operator.T @ torch.linalg.inv(inner)
    return mean + gain @ (value - operator @ mean), covariance - gain @ operator @ covariance


@pytest.mark.parametrize("rotation", [False, True])
@pytest.mark.parametrize("members", [2, 5, 12])
def test_etkf_is_the_kalman_filter(members, rotation):
    ensemble, operator, observations = problem(members)
    filter_ = ETKF(rotation=rotation)
    analysis = filter_.analyse(ensemble, ensemble @ operator.T, observations, generator=generator(1))
    mean, covariance = kalman(
        ensemble.mean(0), torch.cov(ensemble.T), operator, observations.value, observations.variance
    )
    assert torch.allclose(analysis.mean, mean, atol=1e-10, rtol=0)
    assert torch.allclose(torch.cov(analysis.ensemble.T), covariance, atol=1e-10, rtol=0)


def test_subspace_update_is_the_kalman_filter():
    ensemble, operator, observations = problem()
    subspace = ErrorSubspace.from_ensemble(ensemble)
    assert torch.allclose(subspace.covariance(), torch.cov(ensemble.T), atol=1e-12)
    updated = subspace.update(
        subspace.modes @ operator.T, observations.value - operator @ subspace.mean, 1 / observations.variance
    )
    mean, covariance = kalman(subspace.mean, subspace.covariance(), operator, observations.value, observations.variance)
    assert torch.allclose(updated.mean, mean, atol=1e-11)
    assert torch.allclose(updated.covariance(), covariance, atol=1e-11)
    assert torch.allclose(updated.variance(), covariance.diagonal(), atol=1e-11)


def test_subspace_sum_inflation_and_truncation():
    ensemble, _, _ = problem(members=6, state=9)
    noise = torch.randn(3, 9, generator=generator(3), dtype=torch.float64)
    subspace = ErrorSubspace.from_ensemble(ensemble)
    total = subspace.inflated(1.5).plus(noise)
    dense = 2.25 * torch.cov(ensemble.T) + noise.T @ noise
    assert torch.allclose(total.covariance(), dense, atol=1e-12)
    value, vector = torch.linalg.eigh(dense)
    best = (vector[:, -4:] * value[-4:]) @ vector[:, -4:].T
    assert torch.allclose(total.truncated(4).covariance(), best, atol=1e-12)
    assert torch.allclose(total.truncated(20).covariance(), dense, atol=1e-12)
    assert total.truncated(20).rank == 20


def test_basis_is_orthonormal_and_sums_to_zero():
    for size in (2, 3, 17):
        basis = zero_sum_basis(size)
        assert torch.allclose(basis.T @ basis, torch.eye(size - 1, dtype=torch.float64), atol=1e-14)
        assert basis.sum(0).abs().max() < 1e-14


def test_stochastic_filter_converges_to_the_kalman_filter():
    """Monte Carlo error falls as N^-1/2: the measured order over N = 16 ... 256 must be near it."""
    draw = generator(5)
    operator = torch.randn(3, 4, generator=draw, dtype=torch.float64)
    covariance = torch.eye(4, dtype=torch.float64) + 0.3
    factor = torch.linalg.cholesky(covariance)
    value, variance = torch.tensor([1.0, -2.0, 0.5]).double(), torch.tensor([0.5, 1.0, 0.3]).double()
    mean_a, covariance_a = kalman(torch.ones(4).double(), covariance, operator, value, variance)
    sizes, errors = (16, 64, 256), []
    for size in sizes:
        ensemble = 1 + torch.randn(30, size, 4, generator=draw, dtype=torch.float64) @ factor.T
        analysis = StochasticEnKF().analyse(
            ensemble, ensemble @ operator.T, Observations(value.expand(30, 3), variance), generator=draw
        )
        anomalies = analysis.ensemble - analysis.mean.unsqueeze(-2)
        sampled = anomalies.mT @ anomalies / (size - 1)
        error = (analysis.mean - mean_a).square().sum(-1) + (sampled - covariance_a).square().sum((-2, -1))
        errors.append(error.mean().sqrt())
    order = torch.log(errors[0] / errors[2]) / torch.log(torch.tensor(sizes[2] / sizes[0]))
    assert 0.4 < order < 0.6
    assert errors[2] < 0.3


def test_stochastic_filter_is_the_gain_with_perturbed_observations():
    ensemble, operator, observations = problem()
    analysis = StochasticEnKF().analyse(ensemble, ensemble @ operator.T, observations, generator=generator(2))
    noise = torch.randn(12, 5, generator=generator(2), dtype=torch.float64)
    noise = (noise - noise.mean(0)) * observations.variance.sqrt()
    covariance = torch.cov(ensemble.T)
    inner = operator @ covariance @ operator.T + torch.diag(observations.variance)
    gain = covariance @ operator.T @ torch.linalg.inv(inner)
    expected = ensemble + (observations.value + noise - ensemble @ operator.T) @ gain.T
    assert torch.allclose(analysis.ensemble, expected, atol=1e-10)


def test_etkf_has_the_symmetric_square_root():
    """Members, not only moments: the transform of Hunt et al. 2007, eqs. 21-24, in N x N matrices."""
    ensemble, operator, observations = problem(6)
    mean = ensemble.mean(0)
    observed = (ensemble - mean) @ operator.T
    inverse = 5 * torch.eye(6, dtype=torch.float64) + (observed / observations.variance) @ observed.T
    value, vector = torch.linalg.eigh(torch.linalg.inv(inverse))
    root = (vector * (5 * value).sqrt()) @ vector.T
    shift = torch.linalg.solve(inverse, observed @ ((observations.value - operator @ mean) / observations.variance))
    expected = mean + (root + shift) @ (ensemble - mean)
    analysis = ETKF().analyse(ensemble, ensemble @ operator.T, observations)
    assert torch.allclose(analysis.ensemble, expected, atol=1e-12)


@pytest.mark.parametrize("make", [ETKF, lambda: ETKF(inflation=(RTPS(0.3), Multiplicative(1.1)))])
def test_filters_do_not_care_about_order_or_units(make):
    ensemble, operator, observations = problem(6)
    predicted = ensemble @ operator.T
    plain = make().analyse(ensemble, predicted, observations).ensemble
    members, order = torch.tensor([3, 0, 5, 1, 4, 2]), torch.tensor([4, 2, 0, 1, 3])
    turned = make().analyse(
        ensemble[members],
        predicted[members][:, order],
        Observations(observations.value[order], observations.variance[order]),
    )
    assert torch.allclose(turned.ensemble, plain[members], atol=1e-12)
    unit = torch.tensor([1e-3, 1.0, 1e3, 7.0, 1e-6]).double()
    scaled = make().analyse(
        ensemble * 1e-3,
        predicted * unit,
        Observations(observations.value * unit, observations.variance * unit**2),
    )
    assert torch.allclose(scaled.ensemble, plain * 1e-3, atol=1e-14)


def test_rotation_keeps_mean_and_covariance():
    rotation = random_rotation(9, generator(), batch=(3,))
    one = torch.ones(9, dtype=torch.float64)
    unit = torch.eye(9, dtype=torch.float64).expand(3, 9, 9)
    assert torch.allclose(rotation @ rotation.mT, unit, atol=1e-13)
    assert torch.allclose(rotation @ one, one.expand(3, 9), atol=1e-13)
    assert torch.allclose(one @ rotation, one.expand(3, 9), atol=1e-13)
    assert not torch.allclose(rotation[0], rotation[1], atol=0.1)


def test_missing_observations_are_as_if_absent():
    ensemble, operator, observations = problem(count=6)
    value, variance = observations.value.clone(), observations.variance.clone()
    value[1], variance[4] = torch.nan, torch.inf
    predicted = ensemble @ operator.T
    predicted[3, 2] = torch.nan
    analysis = ETKF().analyse(ensemble, predicted, Observations(value, variance))
    keep = torch.tensor([0, 3, 5])
    alone = ETKF().analyse(ensemble, predicted[:, keep], Observations(value[keep], variance[keep]))
    assert torch.allclose(analysis.ensemble, alone.ensemble, atol=1e-12)
    assert analysis.counts() == {"used": 3, "missing": 1, "no_weight": 1, "not_predicted": 1}
    assert analysis.reason[1] == Reason.MISSING and analysis.reason[2] == Reason.NOT_PREDICTED


def test_nothing_observed_leaves_the_forecast_and_says_so():
    ensemble, operator, observations = problem()
    nothing = Observations(torch.full_like(observations.value, torch.nan), observations.variance)
    for filter_ in (ETKF(), StochasticEnKF()):
        analysis = filter_.analyse(ensemble, ensemble @ operator.T, nothing, generator=generator())
        assert torch.allclose(analysis.ensemble, ensemble, atol=1e-13)
        assert "no observation was used" in analysis.warnings[0]
        empty = Observations(torch.zeros(0).double(), torch.zeros(0).double())
        analysis = filter_.analyse(ensemble, ensemble[:, :0], empty, generator=generator())
        assert torch.allclose(analysis.ensemble, ensemble, atol=1e-13)


def test_gross_errors_are_rejected_by_both_error_sources():
    ensemble, operator, _ = problem(count=4)
    predicted = ensemble @ operator.T
    sigma = (predicted.var(0) + 1).sqrt()
    value = predicted.mean(0) + torch.tensor([0.0, 3.9, 4.1, -4.1]) * sigma
    analysis = ETKF(gross_error=4.0).analyse(ensemble, predicted, Observations(value, torch.ones(4).double()))
    assert analysis.reason.tolist() == [0, 0, Reason.GROSS_ERROR, Reason.GROSS_ERROR]
    assert analysis.normalised_innovation()[1] == pytest.approx(3.9)


def test_duplicate_observations_with_redundancy_count_once():
    ensemble, operator, observations = problem()
    predicted = ensemble @ operator.T
    twice = Observations(observations.value.repeat(2), observations.variance.repeat(2), redundancy=2.0)
    once = ETKF().analyse(ensemble, predicted, observations)
    double = ETKF().analyse(ensemble, predicted.repeat(1, 2), twice)
    assert torch.allclose(once.ensemble, double.ensemble, atol=1e-12)
    naive = ETKF().analyse(ensemble, predicted.repeat(1, 2), twice.with_redundancy(1.0))
    assert naive.spread_after < once.spread_after


def test_collapsed_spread_is_harmless_and_reported():
    ensemble, operator, observations = problem()
    flat = ensemble[:1].expand(12, -1)
    analysis = ETKF(inflation=Multiplicative(1.1)).analyse(flat, flat @ operator.T, observations)
    assert torch.allclose(analysis.ensemble, flat, atol=1e-13)
    assert "collapsed" in analysis.warnings[0]


def test_batch_is_separate_experiments():
    cases = [problem(seed=seed) for seed in range(3)]
    ensemble = torch.stack([case[0] for case in cases])
    predicted = torch.stack([case[0] @ case[1].T for case in cases])
    value = torch.stack([case[2].value for case in cases])
    variance = torch.stack([case[2].variance for case in cases])
    together = ETKF().analyse(ensemble, predicted, Observations(value, variance))
    for k, (members, operator, observations) in enumerate(cases):
        alone = ETKF().analyse(members, members @ operator.T, observations)
        assert torch.allclose(together.ensemble[k], alone.ensemble, atol=1e-12)


def test_float32_states_keep_their_dtype_and_float64_accuracy():
    ensemble, operator, observations = problem()
    single = ETKF().analyse(ensemble.float(), (ensemble @ operator.T).float(), observations)
    double = ETKF().analyse(ensemble, ensemble @ operator.T, observations)
    assert single.ensemble.dtype == torch.float32
    assert torch.allclose(single.ensemble.double(), double.ensemble, atol=3e-6)


def test_same_generator_same_result():
    ensemble, operator, observations = problem()
    for filter_ in (ETKF(rotation=True), StochasticEnKF()):
        runs = [
            filter_.analyse(ensemble, ensemble @ operator.T, observations, generator=generator(4)).ensemble
            for _ in range(2)
        ]
        assert torch.equal(*runs)
        with pytest.raises(AssimilationError, match="generator"):
            filter_.analyse(ensemble, ensemble @ operator.T, observations)


def test_members_may_be_spread_over_processes():
    ensemble, operator, observations = problem()
    analysis = ETKF().analyse(ensemble, ensemble @ operator.T, observations)
    parts = [slice(0, 5), slice(5, 12)]
    gathered = sum(analysis.transform.contribution(ensemble[rows], rows) for rows in parts)
    assert torch.allclose(gathered, analysis.ensemble, atol=1e-12)


def test_bad_input_is_named():
    ensemble, operator, observations = problem()
    predicted = ensemble @ operator.T
    with pytest.raises(AssimilationError, match="at least 2|members >= 2"):
        ETKF().analyse(ensemble[:1], predicted[:1], observations)
    with pytest.raises(AssimilationError, match="4 predicted observations for 5"):
        ETKF().analyse(ensemble, predicted[:, :4], observations)
    with pytest.raises(AssimilationError, match="batch and members"):
        ETKF().analyse(ensemble, predicted[:5], observations)
    broken = ensemble.clone()
    broken[7, 0] = torch.nan
    with pytest.raises(AssimilationError, match=r"members \[\[7\]\] are not finite"):
        ETKF().analyse(broken, predicted, observations)
    with pytest.raises(AssimilationError, match="gross_error"):
        ETKF(gross_error=-1.0)
