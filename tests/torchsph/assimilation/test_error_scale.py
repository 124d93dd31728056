"""Learning the size of observation errors: known factors, outliers, and a filter that was told nonsense."""

import pytest
import torch
from scipy.stats import chi2

from torchsph.assimilation import ETKF, RTPS, AssimilationError, ErrorScale, Observations
from torchsph.assimilation.diagnostics.scores import CHI2_MEDIAN
from torchsph.assimilation.twins.models import Lorenz96


def cycle(draw, sigma, outliers=0.0, count=400):
    """A reliable ensemble of spread 1 with observations of true standard deviation `sigma (count,)`."""
    ensemble = torch.randn(60, count, generator=draw, dtype=torch.float64)
    value = torch.randn(count, generator=draw, dtype=torch.float64)
    value = value + sigma * torch.randn(count, generator=draw, dtype=torch.float64)
    far = torch.rand(count, generator=draw, dtype=torch.float64) < outliers
    return ensemble, torch.where(far, value + 50.0, value)


def test_the_median_is_scipys():
    assert chi2.median(1) == pytest.approx(CHI2_MEDIAN, abs=1e-14)


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_factors_of_two_groups_are_found(outliers):
    draw = torch.Generator().manual_seed(0)
    scale = ErrorScale(groups=2)
    group = (torch.arange(400) >= 200).long()
    sigma = torch.where(group == 1, 3.0, 0.7)
    for _ in range(30):
        ensemble, value = cycle(draw, sigma, outliers)
        seen = scale.apply(Observations(value, torch.ones(400).double()), group)
        scale.learn(ETKF(gross_error=4.0).analyse(ensemble, ensemble, seen), seen, group)
    expected = torch.tensor([0.49, 9.0]).double()
    assert torch.allclose(scale.factor, expected, rtol=0.15 if outliers == 0 else 0.8)


def test_a_filter_told_a_hundredth_of_the_variance_finds_its_way():
    """Lorenz-96 observed with variance 1, told 0.01: learned, it ends near the filter that was told the
    truth.
    """

    def run(told, learn):
        draw = torch.Generator().manual_seed(0)
        truth = 8 + torch.randn(40, generator=draw, dtype=torch.float64)
        ensemble = truth + torch.randn(40, 40, generator=draw, dtype=torch.float64)
        scale, errors = ErrorScale(), []
        filter_ = ETKF(inflation=RTPS(0.4), rotation=True, gross_error=4.0)
        for _ in range(200):
            truth, ensemble = Lorenz96()(truth), Lorenz96()(ensemble)
            value = truth + torch.randn(40, generator=draw, dtype=torch.float64)
            seen = Observations(value, torch.full((40,), told).double())
            seen = scale.apply(seen) if learn else seen
            analysis = filter_.analyse(ensemble, ensemble, seen, generator=draw)
            if learn:
                scale.learn(analysis, seen)
            ensemble = analysis.ensemble
            errors.append((analysis.mean - truth).square().mean().sqrt().item())
        return sum(errors[100:]) / 100, scale.factor.item()

    right, _ = run(1.0, learn=False)
    wrong, _ = run(0.01, learn=False)
    learned, factor = run(0.01, learn=True)
    assert factor == pytest.approx(100, rel=0.25)
    assert learned < 1.15 * right < wrong


def test_missing_groups_and_checkpoints():
    draw = torch.Generator().manual_seed(0)
    first, second = ErrorScale(groups=3), ErrorScale(groups=3)
    ensemble, value = cycle(draw, 2.0)
    seen = Observations(value, torch.ones(400).double())
    analysis = ETKF().analyse(ensemble, ensemble, seen)
    first.learn(analysis, seen, group=1)
    assert first.factor[0] == 1 and first.factor[2] == 1 and first.factor[1] > 2
    second.restore(first.state())
    for scale in (first, second):
        scale.learn(analysis, seen, group=1)
    assert torch.equal(first.factor, second.factor)
    with pytest.raises(AssimilationError, match="groups"):
        ErrorScale(groups=0)
