"""Robust weights: what they discard, and the noise they would otherwise understate."""

import pytest
import torch

from regularize import InvalidInput
from regularize.statistics.robust import inflation, robust_weight


@pytest.mark.parametrize("kind", ["tukey", "huber"])
@pytest.mark.parametrize("components", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_inflation_equals_simulation(kind, components):
    """Spread of the location estimate of Gaussian samples against what the weighted residuals claim."""
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(4000, 400, components, generator=generator, dtype=torch.float64)
    estimate, claimed = [], []
    for sample in draws.split(1):
        residual = sample[0]
        weight = robust_weight(residual, kind)
        claimed.append((weight**2 * residual.square().T).sum() / weight.sum() / components)
        for _ in range(3):  # reweighting to convergence around the moving centre
            centre = (weight[:, None] * sample[0]).sum(0) / weight.sum()
            weight = robust_weight(sample[0] - centre, kind)
        estimate.append(centre)
    spread = torch.stack(estimate).square().mean() * 400
    # claimed variance of the centre: noise^2 over the sum of the weights
    mean_weight = float(robust_weight(draws.view(-1, components), kind).mean())
    believed = torch.stack(claimed).mean() * inflation(kind, components) ** 2 / mean_weight
    assert float(believed) == pytest.approx(float(spread), rel=0.05)


def test_a_hop_in_one_component_discards_the_vector():
    residual = torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    residual[7] = torch.tensor([0.0, 0.0, 20.0])
    assert float(robust_weight(residual, "tukey")[7]) == 0
    assert 0 < float(robust_weight(residual, "huber")[7]) < 0.2


def test_exact_data_and_unknown_kinds():
    assert float(robust_weight(torch.zeros(5, 2), "tukey").min()) == 1
    with pytest.raises(InvalidInput, match="robust"):
        robust_weight(torch.zeros(5, 2), "cauchy")
