"""Hybrid gain, augmented parameters, correlated observation errors."""

import pytest
import torch

from torchsph.assimilation import (
    ETKF,
    LETKF,
    AssimilationError,
    Augmentation,
    HybridGain,
    Localisation,
    Multiplicative,
    Observations,
    Parameter,
    Reason,
    gaussian_correlation,
    redundancy,
    thin,
)
from torchsph.assimilation.twins.models import Lorenz96


def double(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_hybrid_mean_and_perturbations():
    ensemble, operator = double(8, 5), double(3, 5, seed=1)
    seen = Observations(double(3, seed=2), torch.ones(3).double())
    alone = ETKF().analyse(ensemble, ensemble @ operator.T, seen)
    hybrid = HybridGain(filter=ETKF(), second=lambda mean, _: mean + 1, weight=0.25)
    analysis = hybrid.analyse(ensemble, ensemble @ operator.T, seen)
    expected = 0.75 * alone.mean + 0.25 * (ensemble.mean(0) + 1)
    assert torch.allclose(analysis.mean, expected, atol=1e-13)
    assert torch.allclose(analysis.ensemble.mean(0), expected, atol=1e-13)
    assert torch.allclose(analysis.ensemble - expected, alone.ensemble - alone.mean, atol=1e-13)
    later = HybridGain(filter=ETKF(), second=lambda mean, _: mean + 1, weight=0.25, sequential=True)
    assert torch.allclose(later.analyse(ensemble, ensemble @ operator.T, seen).mean, alone.mean + 0.25, atol=1e-13)


def test_second_analysis_hears_of_rejections_but_not_of_localisation():
    place = torch.tensor([[0.0], [1.0], [100.0]]).double()
    ensemble = double(6, 2)
    predicted = torch.cat([ensemble, ensemble[:, :1]], 1)
    value = predicted.mean(0) + torch.tensor([0.0, 1e3, 0.0]).double()
    heard = []

    def second(mean, observations):
        heard.append(observations.codes().tolist())
        return mean

    filter_ = LETKF(localisation=Localisation(5.0), gross_error=5.0)
    analysis = HybridGain(filter=filter_, second=second).analyse(
        ensemble, predicted, Observations(value, torch.ones(3).double(), place), state_positions=place[:2]
    )
    assert analysis.reason.tolist() == [0, Reason.GROSS_ERROR, Reason.OUT_OF_REACH]
    assert heard == [[0, Reason.GROSS_ERROR, 0]]


def test_hybrid_refuses_a_broken_second_analysis():
    ensemble = double(6, 2)
    seen = Observations(torch.zeros(2).double(), torch.ones(2).double())
    for broken in (lambda mean, _: mean[:1], lambda mean, _: mean * torch.nan):
        with pytest.raises(AssimilationError, match="second analysis"):
            HybridGain(filter=ETKF(), second=broken).analyse(ensemble, ensemble, seen)
    with pytest.raises(AssimilationError, match="weight"):
        HybridGain(filter=ETKF(), second=lambda mean, _: mean, weight=1.5)


@pytest.mark.parametrize(("low", "high"), [(-torch.inf, torch.inf), (0.5, torch.inf), (-1.0, 3.0)])
def test_parameters_round_trip_and_stay_inside_their_bounds(low, high):
    parameter = Parameter("p", low, high)
    value = torch.tensor([0.6, 1.0, 2.9]).double()
    assert torch.allclose(parameter.decode(parameter.encode(value)), value, atol=1e-14)
    far = parameter.decode(torch.tensor([-30.0, 30.0]).double())
    assert (far >= low).all() and (far <= high).all()


def test_augmentation_joins_and_splits():
    augmentation = Augmentation((Parameter("a", low=0.0), Parameter("b", smallest_spread=0.5)))
    state = double(6, 4).float()
    values = {"a": double(6, seed=1).exp(), "b": 7 + 0.01 * double(6, seed=2)}
    whole = augmentation.join(state, values)
    assert whole.shape == (6, 6) and whole.dtype == torch.float32
    back, again = augmentation.split(whole)
    assert torch.equal(back, state)
    assert torch.allclose(again["a"], values["a"], rtol=1e-6)
    assert again["b"].std().item() == pytest.approx(0.5) and again["b"].mean().item() == pytest.approx(
        values["b"].mean().item(), abs=1e-5
    )
    places = augmentation.positions(torch.zeros(2, 3), 4)
    assert places.shape == (6, 3) and places[4:].isnan().all() and not places[:4].isnan().any()


def test_augmentation_errors():
    with pytest.raises(AssimilationError, match="between"):
        Parameter("a", low=0.0).encode(torch.tensor([-1.0]))
    with pytest.raises(AssimilationError, match="low < high"):
        Parameter("a", low=1.0, high=0.0)
    with pytest.raises(AssimilationError, match="lower one"):
        Parameter("a", high=0.0)
    with pytest.raises(AssimilationError, match="do not match"):
        Augmentation((Parameter("a"),)).join(torch.zeros(3, 2), {"b": torch.zeros(3)})


@pytest.mark.parametrize("local", [False, True])
def test_an_unknown_forcing_is_found_from_the_state_alone(local):
    """Lorenz-96 with F = 8; members start with F about 6 and only ever observe the state."""
    draw = torch.Generator().manual_seed(0)
    truth = 8 + torch.randn(40, generator=draw, dtype=torch.float64)
    ensemble = truth + torch.randn(24, 40, generator=draw, dtype=torch.float64)
    forcing = 6 + 0.7 * torch.randn(24, generator=draw, dtype=torch.float64)
    augmentation = Augmentation((Parameter("forcing", low=0.0, smallest_spread=0.01),))
    place = torch.arange(40, dtype=torch.float64).unsqueeze(-1)
    inflation = Multiplicative(1.02)
    ring = Localisation(14.0, period=(40.0,))
    filter_ = LETKF(localisation=ring, inflation=inflation) if local else ETKF(inflation=inflation)
    for _ in range(200):
        truth = Lorenz96()(truth)
        ensemble = Lorenz96(forcing=forcing.unsqueeze(-1))(ensemble)
        value = truth + torch.randn(40, generator=draw, dtype=torch.float64)
        analysis = filter_.analyse(
            augmentation.join(ensemble, {"forcing": forcing}),
            ensemble,
            Observations(value, torch.ones(40).double(), place),
            state_positions=augmentation.positions(place, 40),
        )
        ensemble, values = augmentation.split(analysis.ensemble)
        forcing = values["forcing"]
    assert forcing.mean().item() == pytest.approx(8, abs=0.15)
    assert (ensemble.mean(0) - truth).square().mean().sqrt() < 0.5


def test_redundancy_is_exact_for_a_constant_under_circulant_errors():
    """The generalised least-squares variance of a constant is 1 / (1' R^-1 1)."""
    count, length = 60, 2.0
    circle = 2 * torch.pi * torch.arange(count, dtype=torch.float64) / count
    place = torch.stack([circle.cos(), circle.sin()], -1) * count / (2 * torch.pi)
    correlation = gaussian_correlation(length)
    factor = redundancy(place, correlation, reach=100.0)
    matrix = 0.5 * correlation(torch.cdist(place, place))
    one = torch.ones(count).double()
    exact = 1 / (one @ torch.linalg.solve(matrix + 1e-9 * torch.eye(count), one))
    assert (1 / (1 / (0.5 * factor)).sum()).item() == pytest.approx(exact.item(), rel=1e-4)
    # A filter told of it is as certain as it should be; told nothing, it is overconfident.
    ensemble = 3 * double(40, 1)
    predicted = ensemble.expand(40, count)
    seen = Observations(torch.zeros(count).double(), torch.full((count,), 0.5).double(), place, factor)
    prior = ensemble.var(0)
    optimal = 1 / (1 / prior + 1 / exact)
    told = ETKF().analyse(ensemble, predicted, seen).variance.item()
    assert told == pytest.approx(optimal.item(), rel=1e-4)
    assert ETKF().analyse(ensemble, predicted, seen.with_redundancy(1.0)).variance < 0.5 * optimal


def test_redundancy_counts_used_neighbours_only():
    place = torch.tensor([[0.0], [0.0], [5.0]])
    flat = redundancy(place, torch.ones_like, reach=1.0)
    assert flat.tolist() == [2, 2, 1]
    used = torch.tensor([True, False, True])
    assert redundancy(place, torch.ones_like, reach=1.0, used=used).tolist() == [1, 1, 1]
    with pytest.raises(AssimilationError, match="reach"):
        redundancy(place, torch.ones_like, reach=0.0)


def test_thinning_keeps_the_best_of_each_cell():
    place = torch.tensor([[0.1, 0.1], [0.9, 0.2], [1.5, 0.0], [1.1, 0.9], [0.0, 0.0]])
    assert thin(place, 1.0).tolist() == [True, False, True, False, False]
    weight = torch.tensor([1.0, 3.0, 1.0, 2.0, 1.0])
    assert thin(place, 1.0, priority=weight).tolist() == [False, True, False, True, False]
    assert thin(place[:0], 1.0).shape == (0,)
