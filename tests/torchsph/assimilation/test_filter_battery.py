"""What every filter owes, whichever it is: run on each of ``FILTERS``, to which a new filter is added."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from torchsph import assimilation
from torchsph.assimilation import (
    ETKF,
    LETKF,
    Analysis,
    AssimilationError,
    EnsembleFilter,
    Filter,
    HybridGain,
    Localisation,
    Observations,
    Reason,
    ReducedUnscented,
    StochasticEnKF,
    Symmetric,
    replace_failed,
)

STATE, COUNT = 6, 4


@dataclass(frozen=True)
class Case:
    """A filter and how its promises are to be read.

    Attributes:
        make: the filter, with the options that make it as good as it can be on a small linear problem.
        tolerance: of its mean and covariance against the Kalman filter's; for filters that draw, a sampling error.
        divisor: of the covariance of N members.
        draws: whether it needs a generator.
        permutes: whether members may be reordered.
        members: N of the cases.
    """

    make: Callable[[], Filter]
    tolerance: float = 1e-9
    divisor: Callable[[int], int] = lambda members: members - 1
    draws: bool = False
    permutes: bool = True
    members: int = 9


def forecast_mean(mean: Tensor, observations: Observations) -> Tensor:
    """A second analysis that knows nothing."""
    return mean


FILTERS: dict[str, Case] = {
    "enkf": Case(StochasticEnKF, tolerance=0.12, draws=True, permutes=False, members=500),
    "etkf": Case(ETKF),
    "etkf, rotated": Case(lambda: ETKF(rotation=True), draws=True, permutes=False),
    # a radius so large that nothing is tapered
    "letkf": Case(lambda: LETKF(localisation=Localisation(1e6), patch=None), tolerance=1e-6),
    "hybrid": Case(lambda: HybridGain(filter=ETKF(), second=forecast_mean, weight=0.0)),
    "unscented, simplex": Case(ReducedUnscented, divisor=lambda members: members, permutes=False),
    "unscented, symmetric": Case(
        lambda: ReducedUnscented(points=Symmetric()), divisor=lambda members: members, permutes=False
    ),
}


@pytest.fixture(params=FILTERS)
def case(request) -> Case:
    return FILTERS[request.param]


@dataclass(frozen=True)
class Problem:
    """A linear Gaussian problem: y = H x + e."""

    ensemble: Tensor
    operator: Tensor
    observations: Observations

    @property
    def predicted(self) -> Tensor:
        return self.ensemble @ self.operator.T


def problem(case: Case, seed: int = 0) -> Problem:
    """As many members as the case asks for, their mean and covariance any; places on a line for local filters."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    mix, place = torch.eye(STATE, dtype=torch.float64) + 0.3 * normal(STATE, STATE), torch.arange(COUNT)
    ensemble = 2.0 + normal(case.members, STATE) @ mix
    variance = 0.3 + torch.rand(COUNT, generator=draw, dtype=torch.float64)
    observations = Observations(normal(COUNT), variance, position=place.double()[:, None])
    return Problem(ensemble, normal(COUNT, STATE), observations)


def analysed(filter_: Filter, given: Problem, observations: Observations | None = None, seed: int = 1) -> Analysis:
    return filter_.analyse(
        given.ensemble,
        given.predicted,
        given.observations if observations is None else observations,
        state_positions=torch.arange(STATE, dtype=torch.float64)[:, None],
        generator=torch.Generator().manual_seed(seed),
    )


def covariance(members: Tensor, divisor: int) -> Tensor:
    anomalies = members - members.mean(0)
    return anomalies.T @ anomalies / divisor


def sigma_mean_and_covariance(filter_: Filter, case: Case, members: Tensor) -> tuple[Tensor, Tensor]:
    """What the members stand for: weighted points for sigma points, a sample otherwise."""
    if isinstance(filter_, ReducedUnscented):
        rule = filter_.points
        weight, coordinate = rule.rule(rule.rank(len(members)))
        modes = (weight[:, None] * coordinate).T @ members
        return weight @ members, modes.T @ modes
    return members.mean(0), covariance(members, case.divisor(len(members)))


def kalman(mean: Tensor, prior: Tensor, given: Problem) -> tuple[Tensor, Tensor]:
    """Textbook Kalman update, dense (Kalman 1960, J. Basic Eng. 82, 35)."""
    operator, variance = given.operator, given.observations.variance
    gain = prior @ operator.T @ torch.linalg.inv(operator @ prior @ operator.T + torch.diag(variance))
    return mean + gain @ (given.observations.value - operator @ mean), prior - gain @ operator @ prior


def odd_part(filter_: Filter, given: Problem) -> Problem:
    """For sigma points a set whose even part is none, so that no variance is moved about."""
    if not isinstance(filter_, ReducedUnscented):
        return given
    rule = filter_.points
    weight, coordinate = rule.rule(rule.rank(len(given.ensemble)))
    modes = (weight[:, None] * coordinate).T @ given.ensemble
    points = weight @ given.ensemble + coordinate @ modes
    return Problem(points, given.operator, given.observations)


def test_it_is_the_kalman_filter_of_a_linear_problem(case):
    filter_ = case.make()
    given = odd_part(filter_, problem(case))
    mean, expected = kalman(*sigma_mean_and_covariance(filter_, case, given.ensemble), given)
    analysis = analysed(filter_, given)
    found, spread = sigma_mean_and_covariance(filter_, case, analysis.ensemble)
    torch.testing.assert_close(analysis.mean, mean, atol=case.tolerance, rtol=0)
    torch.testing.assert_close(found, mean, atol=case.tolerance, rtol=0)
    torch.testing.assert_close(spread, expected, atol=case.tolerance, rtol=0)
    torch.testing.assert_close(analysis.variance, expected.diagonal(), atol=case.tolerance, rtol=0)


def test_its_covariance_is_positive_and_no_larger_than_the_forecasts(case):
    """In every direction; with observations of all precisions, a nearly exact one among them."""
    filter_ = case.make()
    given = odd_part(filter_, problem(case, seed=2))
    variance = torch.tensor([1e-8, 1e-2, 1.0, 1e6], dtype=torch.float64)
    observations = Observations(given.observations.value, variance, position=given.observations.position)
    analysis = analysed(filter_, given, observations)
    before = sigma_mean_and_covariance(filter_, case, given.ensemble)[1]
    after = sigma_mean_and_covariance(filter_, case, analysis.ensemble)[1]
    scale = float(torch.linalg.eigvalsh(before).max())
    assert torch.isfinite(analysis.ensemble).all() and (analysis.variance >= 0).all()
    assert torch.linalg.eigvalsh(after).min() > -1e-12 * scale
    assert torch.linalg.eigvalsh(before - after).min() > -max(case.tolerance, 1e-9) * scale


def test_observations_that_are_missing_are_as_if_absent(case):
    filter_ = case.make()
    given = problem(case, seed=3)
    value, variance = given.observations.value.clone(), given.observations.variance.clone()
    value[1], variance[3] = torch.nan, torch.inf
    position = given.observations.position
    analysis = analysed(filter_, given, Observations(value, variance, position=position))
    assert analysis.counts() == {"used": 2, "missing": 1, "no_weight": 1}
    keep = torch.tensor([0, 2])
    fewer = Problem(given.ensemble, given.operator[keep], Observations(value[keep], variance[keep], position[keep]))
    alone = analysed(filter_, fewer)
    # a filter that draws draws otherwise for fewer observations
    torch.testing.assert_close(analysis.mean, alone.mean, atol=case.tolerance, rtol=0)
    torch.testing.assert_close(analysis.variance, alone.variance, atol=case.tolerance, rtol=0)


def test_without_observations_the_forecast_stays(case):
    filter_ = case.make()
    given = odd_part(filter_, problem(case))
    silent = Observations(
        torch.full((COUNT,), torch.nan, dtype=torch.float64),
        given.observations.variance,
        position=given.observations.position,
    )
    analysis = analysed(filter_, given, silent)
    assert (analysis.reason == Reason.MISSING).all()
    mean, spread = sigma_mean_and_covariance(filter_, case, given.ensemble)
    found, kept = sigma_mean_and_covariance(filter_, case, analysis.ensemble)
    torch.testing.assert_close(found, mean, atol=1e-12, rtol=0)
    torch.testing.assert_close(kept, spread, atol=1e-11, rtol=0)


def test_a_dead_member_is_refused_by_number_and_served_after_its_replacement(case):
    filter_ = case.make()
    given = problem(case)
    broken = given.ensemble.clone()
    broken[3, 1] = torch.nan
    with pytest.raises(AssimilationError, match=r"members \[\[3\]\] are not finite"):
        analysed(filter_, Problem(broken, given.operator, given.observations))
    failed = ~torch.isfinite(broken).all(-1)
    repaired = replace_failed(broken, failed, torch.Generator().manual_seed(0)).ensemble
    assert torch.isfinite(analysed(filter_, Problem(repaired, given.operator, given.observations)).ensemble).all()


def test_a_prediction_that_one_member_lacks_is_not_used(case):
    filter_ = case.make()
    given = problem(case)
    predicted = given.predicted.clone()
    predicted[2, 1] = torch.nan
    analysis = filter_.analyse(
        given.ensemble,
        predicted,
        given.observations,
        state_positions=torch.arange(STATE, dtype=torch.float64)[:, None],
        generator=torch.Generator().manual_seed(1),
    )
    assert analysis.reason.tolist() == [0, int(Reason.NOT_PREDICTED), 0, 0]
    assert torch.isfinite(analysis.ensemble).all()


def test_the_same_seed_gives_the_same_bits(case):
    given = problem(case)
    first, second = (analysed(case.make(), given).ensemble for _ in range(2))
    assert torch.equal(first, second)
    if case.draws:
        assert not torch.equal(first, analysed(case.make(), given, seed=2).ensemble)
        with pytest.raises(AssimilationError, match="generator"):
            case.make().analyse(
                given.ensemble, given.predicted, given.observations, state_positions=torch.zeros(STATE, 1).double()
            )


@pytest.mark.parametrize("name", [name for name, case in FILTERS.items() if case.permutes])
def test_members_may_come_in_any_order(name):
    """But for random numbers and the rule of sigma points, which belong to members by their number."""
    case = FILTERS[name]
    given = problem(case)
    order = torch.randperm(case.members, generator=torch.Generator().manual_seed(4))
    plain = analysed(case.make(), given).ensemble
    turned = analysed(case.make(), Problem(given.ensemble[order], given.operator, given.observations)).ensemble
    torch.testing.assert_close(turned, plain[order], atol=1e-10, rtol=0)


def test_observations_may_come_in_any_order(case):
    given = problem(case)
    order, seen = torch.tensor([2, 0, 3, 1]), given.observations
    turned = Observations(seen.value[order], seen.variance[order], position=seen.position[order])
    plain, other = (
        analysed(case.make(), given),
        analysed(case.make(), Problem(given.ensemble, given.operator[order], turned)),
    )
    torch.testing.assert_close(other.mean, plain.mean, atol=case.tolerance, rtol=0)
    torch.testing.assert_close(other.reason, plain.reason[order])


def test_what_it_uses_is_what_it_screened(case):
    given = problem(case)
    filter_ = case.make()
    screened = filter_.screen(given.ensemble, given.predicted, given.observations)
    assert torch.equal(screened.reason, analysed(filter_, given).reason)
    torch.testing.assert_close(screened.weight, 1.0 / given.observations.variance)


def test_a_single_precision_state_keeps_its_type(case):
    given = problem(case)
    single = Problem(given.ensemble.float(), given.operator.float(), given.observations)
    found, exact = analysed(case.make(), single), analysed(case.make(), given)
    assert found.ensemble.dtype == torch.float32
    torch.testing.assert_close(found.mean.double(), exact.mean, atol=2e-5, rtol=2e-5)


def test_every_filter_of_the_package_is_in_the_list():
    """A new filter that is not tested here is noticed here."""
    public = {getattr(assimilation, name) for name in assimilation.__all__}
    filters = {
        part
        for part in public
        if inspect.isclass(part) and issubclass(part, EnsembleFilter) and not inspect.isabstract(part)
    }
    assert filters | {HybridGain} == {type(case.make()) for case in FILTERS.values()}
