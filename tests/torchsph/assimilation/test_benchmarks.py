"""Published analysis errors (DAPPER's tables, see `benchmarks`): all of them as slow tests, a few
shortened.
"""

import pytest
import torch

from torchsph.assimilation import ETKF, AssimilationError
from torchsph.assimilation.twins.benchmarks import benchmarks, lorenz96

CASES = {case.name: case for case in benchmarks()}


def check(case, result, better=0.8):
    assert not result.diverged.any()
    assert better * case.expected < result.median < 1.15 * case.expected
    for name, (_, expected) in case.sectors.items():
        assert better * expected < result.sectors[name].median() < 1.15 * expected


@pytest.mark.parametrize(
    ("name", "cycles"),
    [
        ("L96 ETKF N24", 600),
        ("L96 LETKF N7", 550),
        ("advection ETKF N30", 112),
        ("advection stochastic N30", 112),
    ],
)
def test_published_errors_in_short(name, cycles):
    check(CASES[name], CASES[name].run(cycles=cycles, experiments=5))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_published_errors(name):
    check(CASES[name], CASES[name].run(seed=1))


def test_divergence_is_detected():
    """Without inflation and with far too few members the global filter loses the truth."""
    case = CASES["L96 ETKF N24"]
    few = type(case)(**{**case.__dict__, "filter": ETKF(), "members": 6, "cycles": 300, "burn_in": 200})
    result = few.run(experiments=3)
    assert result.diverged.all()
    assert (result.spread < 0.3 * result.error).all()


def test_runs_are_reproducible():
    case = CASES["L96 stochastic N40"]
    short = type(case)(**{**case.__dict__, "cycles": 6, "burn_in": 2})
    first, second, other = (short.run(experiments=2, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(first.error, second.error) and not torch.equal(first.error, other.error)


def test_burn_in_is_checked():
    from torchsph.assimilation.twins.twin import run_twin

    with pytest.raises(AssimilationError, match="burn_in"):
        run_twin(lorenz96(), ETKF(), members=5, cycles=5, burn_in=5)
