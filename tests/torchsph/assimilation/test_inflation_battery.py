"""What every inflation method owes: run on each of ``INFLATIONS``, to which a new method is added."""

from __future__ import annotations

import pytest
import torch

from torchsph.assimilation import (
    ETKF,
    LETKF,
    RTPP,
    RTPS,
    Adaptive,
    Localisation,
    Multiplicative,
    Observations,
)

INFLATIONS = {
    "multiplicative": lambda: Multiplicative(1.2),
    "rtps": lambda: RTPS(0.6),
    "rtpp": lambda: RTPP(0.6),
    "adaptive": Adaptive,
}


@pytest.fixture(params=INFLATIONS)
def make(request):
    return INFLATIONS[request.param]


def given(members=8, state=5, seed=0):
    draw = torch.Generator().manual_seed(seed)
    ensemble = torch.randn(members, state, generator=draw, dtype=torch.float64)
    value = 3.0 + torch.randn(state, generator=draw, dtype=torch.float64)  # farther off than the spread allows
    place = torch.arange(state, dtype=torch.float64)[:, None]
    return ensemble, Observations(value, torch.full((state,), 0.5, dtype=torch.float64), position=place)


def test_the_spread_grows_and_stays_within_the_forecasts_inflated_one(make):
    ensemble, observations = given()
    plain = ETKF().analyse(ensemble, ensemble, observations)
    inflated = ETKF(inflation=make()).analyse(ensemble, ensemble, observations)
    assert (inflated.ensemble.var(0) >= plain.ensemble.var(0) - 1e-12).all()
    assert float(inflated.spread_after) > float(plain.spread_after)
    bound = max(1.2, float(inflated.prior_factor))
    assert (inflated.ensemble.std(0) <= bound * ensemble.std(0) + 1e-12).all()


def test_members_keep_their_mean_as_the_estimate(make):
    ensemble, observations = given()
    analysis = ETKF(inflation=make()).analyse(ensemble, ensemble, observations)
    torch.testing.assert_close(analysis.ensemble.mean(0), analysis.mean, atol=1e-12, rtol=0)


def test_where_nothing_is_observed_nothing_is_inflated(make):
    """Spread that nothing takes away must not grow without bound; half of the line is out of reach."""
    ensemble, observations = given(state=20)
    place = torch.arange(20, dtype=torch.float64)[:, None]
    near = Observations(observations.value[:1], observations.variance[:1], position=place[:1])
    filter_ = LETKF(localisation=Localisation(5.0), inflation=make(), patch=None)
    analysis = filter_.analyse(ensemble, ensemble[:, :1], near, state_positions=place)
    torch.testing.assert_close(analysis.ensemble[:, 6:], ensemble[:, 6:], atol=1e-12, rtol=0)
    assert (analysis.ensemble[:, 0] - ensemble[:, 0]).abs().max() > 1e-3


def test_members_may_come_in_any_order(make):
    ensemble, observations = given()
    order = torch.randperm(len(ensemble), generator=torch.Generator().manual_seed(1))
    plain, turned = (ETKF(inflation=make()).analyse(e, e, observations).ensemble for e in (ensemble, ensemble[order]))
    torch.testing.assert_close(turned, plain[order], atol=1e-12, rtol=0)


def test_a_collapsed_ensemble_stays_finite(make):
    ensemble, observations = given()
    flat = ensemble[:1].expand(len(ensemble), -1)
    analysis = ETKF(inflation=make()).analyse(flat, flat, observations)
    torch.testing.assert_close(analysis.ensemble, flat, atol=1e-12, rtol=0)
