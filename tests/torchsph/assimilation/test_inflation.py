"""Inflation methods against their defining formulas and a known spread deficit."""

import pytest
import torch

from torchsph.assimilation import ETKF, RTPP, RTPS, Adaptive, AssimilationError, Multiplicative, Observations

DRAW = torch.Generator()


def case(members=20, state=4, seed=0):
    draw = torch.Generator().manual_seed(seed)
    ensemble = torch.randn(members, state, generator=draw, dtype=torch.float64)
    return ensemble, Observations(torch.ones(state).double(), torch.full((state,), 0.5).double())


def test_multiplicative_multiplies_anomalies():
    ensemble, observations = case()
    plain = ETKF().analyse(ensemble, ensemble, observations)
    inflated = ETKF(inflation=Multiplicative(1.2)).analyse(ensemble, ensemble, observations)
    assert torch.allclose(inflated.mean, plain.mean, atol=1e-14)
    assert torch.allclose(inflated.ensemble.std(0), 1.2 * plain.ensemble.std(0), atol=1e-12)


def test_rtps_relaxes_spread():
    ensemble, observations = case()
    plain = ETKF().analyse(ensemble, ensemble, observations)
    relaxed = ETKF(inflation=RTPS(0.7)).analyse(ensemble, ensemble, observations)
    expected = 0.3 * plain.ensemble.std(0) + 0.7 * ensemble.std(0)
    assert torch.allclose(relaxed.ensemble.std(0), expected, atol=1e-12)
    assert torch.allclose(relaxed.mean, plain.mean, atol=1e-14)


def test_rtpp_relaxes_perturbations():
    ensemble, observations = case()
    plain = ETKF().analyse(ensemble, ensemble, observations)
    relaxed = ETKF(inflation=(RTPP(0.4), Multiplicative(1.1))).analyse(ensemble, ensemble, observations)
    expected = 1.1 * (0.6 * (plain.ensemble - plain.mean) + 0.4 * (ensemble - ensemble.mean(0)))
    assert torch.allclose(relaxed.ensemble - relaxed.mean, expected, atol=1e-12)


def test_relaxation_does_nothing_where_nothing_was_observed():
    ensemble, observations = case()
    silent = Observations(torch.full_like(observations.value, torch.nan), observations.variance)
    for inflation in (RTPS(0.9), RTPP(0.9), Adaptive(start=1.0)):
        analysis = ETKF(inflation=inflation).analyse(ensemble, ensemble, silent)
        assert torch.allclose(analysis.ensemble, ensemble, atol=1e-13)


def test_adaptive_finds_a_known_deficit_of_spread():
    """Truth drawn with twice the ensemble's spread: the factor must settle at 2, batched like the state."""
    draw = torch.Generator().manual_seed(7)
    adaptive = Adaptive(drift=0.05)
    factors = []
    for _ in range(150):
        ensemble = torch.randn(2, 40, 50, generator=draw, dtype=torch.float64)
        truth = 2 * torch.randn(2, 50, generator=draw, dtype=torch.float64)
        value = truth + 0.7 * torch.randn(2, 50, generator=draw, dtype=torch.float64)
        observations = Observations(value, torch.full((50,), 0.49).double())
        analysis = ETKF(inflation=adaptive).analyse(ensemble, ensemble, observations)
        factors.append(analysis.prior_factor)
    settled = torch.stack(factors[50:]).mean(0)
    assert settled.shape == (2,)
    assert torch.allclose(settled, torch.full((2,), 2.0).double(), rtol=0.05)
    # The record states the variance that the inflated forecast implies.
    assert analysis.normalised_innovation().square().mean() == pytest.approx(1.0, abs=0.35)


def test_adaptive_state_can_be_restored():
    ensemble, observations = case()
    first, second = Adaptive(), Adaptive()
    ETKF(inflation=first).analyse(ensemble, ensemble, observations)
    second.restore(first.state())
    a = ETKF(inflation=first).analyse(ensemble, ensemble, observations)
    b = ETKF(inflation=second).analyse(ensemble, ensemble, observations)
    assert torch.equal(a.ensemble, b.ensemble)


def test_adaptive_ignores_cycles_without_information():
    ensemble, observations = case()
    adaptive = Adaptive(start=1.4, largest=2.0)
    silent = Observations(torch.full_like(observations.value, torch.nan), observations.variance)
    ETKF(inflation=adaptive).analyse(ensemble, ensemble, silent)
    flat = ensemble[:1].expand(20, -1)
    ETKF(inflation=adaptive).analyse(flat, flat, observations)
    assert adaptive.state()["square"].item() == pytest.approx(1.96)


@pytest.mark.parametrize(
    "make", [lambda: Multiplicative(0.0), lambda: RTPS(1.5), lambda: RTPP(-0.1), lambda: Adaptive(start=0.5)]
)
def test_options_validate_themselves(make):
    with pytest.raises(AssimilationError):
        make()
