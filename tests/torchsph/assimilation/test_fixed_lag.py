"""The fixed-lag smoother against a dense Kalman smoother on the joint state of all times."""

import pytest
import torch

from torchsph.assimilation import ETKF, LETKF, RTPS, AssimilationError, FixedLagSmoother, Localisation, Observations


def double(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def joint_kalman(start, model, operator, values, variance):
    """Mean of every time given all values: one dense update of the stacked trajectory (no model error)."""
    powers = [torch.linalg.matrix_power(model, k + 1) for k in range(len(values))]
    stacked = torch.cat(powers)
    observe = torch.block_diag(*[operator] * len(values)) @ stacked
    mean, covariance = start.mean(0), torch.cov(start.T)
    inner = observe @ covariance @ observe.T + torch.diag(variance.repeat(len(values)))
    gain = covariance @ observe.T @ torch.linalg.inv(inner)
    smoothed = stacked @ (mean + gain @ (torch.cat(values) - observe @ mean))
    return smoothed.reshape(len(values), -1)


@pytest.mark.parametrize("rotation", [False, True])
def test_smoother_is_the_kalman_smoother(rotation):
    start, model, operator = double(9, 5), 0.4 * double(5, 5, seed=1), double(2, 5, seed=2)
    values, variance = [double(2, seed=10 + k) for k in range(6)], torch.tensor([0.5, 1.0]).double()
    draw = torch.Generator().manual_seed(3)
    smoother = FixedLagSmoother(ETKF(rotation=rotation), lag=6)
    ensemble = start
    for value in values:
        ensemble = ensemble @ model.T
        analysis, finished = smoother.analyse(
            ensemble, ensemble @ operator.T, Observations(value, variance), generator=draw
        )
        ensemble = analysis.ensemble
        assert finished is None
    means = torch.stack([state.mean(0) for state in smoother.flush()])
    assert torch.allclose(means, joint_kalman(start, model, operator, values, variance), atol=1e-10, rtol=0)
    assert smoother.flush() == []


def test_lag_delivers_each_state_once_and_can_be_resumed():
    ensemble, operator = double(9, 5), double(2, 5, seed=2)
    seen = Observations(double(2, seed=3), torch.ones(2).double())
    smoother, twin = FixedLagSmoother(ETKF(), lag=2), FixedLagSmoother(ETKF(), lag=2)
    delivered = []
    for cycle in range(5):
        analysis, finished = smoother.analyse(ensemble, ensemble @ operator.T, seen)
        twin.restore(smoother.state())
        ensemble = analysis.ensemble
        delivered.append(finished is not None)
        assert cycle < 2 or finished.shape == ensemble.shape
    assert delivered == [False, False, True, True, True]
    again = [s.analyse(ensemble, ensemble @ operator.T, seen)[1] for s in (smoother, twin)]
    assert torch.equal(*again)


def test_local_filter_smooths_locally():
    place = torch.arange(30, dtype=torch.float64).unsqueeze(-1)
    first, later = double(6, 30), double(6, 30, seed=1)
    none = Observations(torch.full((1,), torch.nan).double(), torch.ones(1).double(), place[:1])
    one = Observations(torch.tensor([3.0]).double(), torch.ones(1).double(), place[:1])
    letkf = LETKF(localisation=Localisation(5.0), inflation=RTPS(0.5))
    smoother = FixedLagSmoother(letkf, lag=1)
    smoother.analyse(first, first[:, :1], none, state_positions=place)
    _, smoothed = smoother.analyse(later, later[:, :1], one, state_positions=place)
    change = (smoothed - first).abs().amax(0)
    assert change[0] > 1e-3 and change[10:].max() < 1e-12


def test_lag_is_checked():
    with pytest.raises(AssimilationError, match="lag"):
        FixedLagSmoother(ETKF(), lag=0)
