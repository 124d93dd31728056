"""Numbers that depend linearly on the field: the update is that of a fit with one more row, and weighs by errors."""

import pytest
import torch

from regularize import InvalidInput, LinearData, Smoother, with_linear_data

NUMBER = 400


@pytest.fixture(scope="module")
def fitted():
    draw = torch.Generator().manual_seed(0)
    points = torch.rand(NUMBER, 3, generator=draw, dtype=torch.float64) * 0.02
    velocity = torch.randn(NUMBER, 3, generator=draw, dtype=torch.float64) * 0.1 + 0.3
    smoother = Smoother(knots=0.01, automatic=None, robust=None, divergence=None, wall=None, no_slip=None)
    return smoother.fit(points, velocity, uncertainty=True)


def mean_over_a_section(value: float, sigma: float) -> LinearData:
    """The mean of v_z over points at z = 1 cm, and that of v_x at z = 5 mm."""
    place = torch.linspace(0.002, 0.018, 5, dtype=torch.float64)
    plane = torch.cartesian_prod(place, place)
    points = torch.cat([torch.cat([plane, torch.full((25, 1), z, dtype=torch.float64)], 1) for z in (0.01, 0.005)])
    rows = torch.zeros(50, 3, dtype=torch.float64)
    rows[:25, 2] = rows[25:, 0] = 1 / 25
    group = torch.arange(2).repeat_interleave(25)
    return LinearData(points, rows, group, torch.tensor([value, 0.0]), torch.tensor([sigma, 1e6]))


def test_an_exact_number_is_met_and_a_useless_one_changes_nothing(fitted):
    before = mean_over_a_section(0.0, 1.0).of(fitted)
    met = with_linear_data(fitted, mean_over_a_section(0.5, 0.0))
    torch.testing.assert_close(mean_over_a_section(0.5, 0.0).of(met)[0].item(), 0.5, rtol=1e-9, atol=0)
    free = with_linear_data(fitted, mean_over_a_section(0.5, 1e6))
    torch.testing.assert_close(mean_over_a_section(0.5, 0.0).of(free), before, rtol=1e-6, atol=0)


def test_the_update_is_the_kalman_update_of_the_dense_covariance(fitted):
    """Against the covariance of the coefficients, inverted whole, in float64."""
    data = mean_over_a_section(0.5, 0.01)
    count = fitted.knots.nodes * 3
    functionals = []
    for number in range(count):
        unit = torch.zeros(count, dtype=torch.float64)
        unit[number] = 1.0
        basis = type(fitted)(fitted.knots, unit.reshape(fitted.coefficients.shape), fitted.covered)
        functionals.append(data.of(basis))
    rows = torch.stack(functionals, 1)
    order, factor = fitted.posterior.ordering, fitted.factor
    size = len(order.nodes)
    columns = factor.solve(torch.eye(3 * size, dtype=torch.float64).reshape(size, 3, -1)).reshape(3 * size, -1)
    inflation = fitted.posterior.inflation.repeat(size)
    covariance = inflation[:, None] * columns * inflation / fitted.posterior.precision
    index = (torch.arange(3) * fitted.knots.nodes)[None, :] + order.nodes[:, None]
    own = rows[:, index.reshape(-1)]
    gain = covariance @ own.T @ torch.linalg.inv(own @ covariance @ own.T + torch.diag(data.sigma.double() ** 2))
    change = torch.zeros(count, dtype=torch.float64)
    change[index.reshape(-1)] = gain @ (data.value.double() - data.of(fitted))
    wanted = fitted.coefficients.double() + change.reshape(fitted.coefficients.shape)
    torch.testing.assert_close(with_linear_data(fitted, data).coefficients.double(), wanted, rtol=1e-7, atol=1e-10)


def test_what_cannot_be_weighed_is_refused(fitted):
    with pytest.raises(InvalidInput, match="sigma must be 0 or more, not"):
        mean_over_a_section(0.5, -1.0)
    bare = type(fitted)(fitted.knots, fitted.coefficients, fitted.covered)
    with pytest.raises(InvalidInput, match="fit it with uncertainty=True"):
        with_linear_data(bare, mean_over_a_section(0.5, 0.1))
