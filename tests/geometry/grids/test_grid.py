"""The grid: where nodes are, sampling against SciPy, its adjoint by dot-tests, derivatives by gradcheck."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from geometry import Grid

GRIDS = [Grid((-1.0, 2.0, 0.5), (0.5, 0.25, 0.2), (4, 5, 6)), Grid((0.1, -0.3), (0.2, 0.1), (7, 5))]


def _random(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _points(grid: Grid, count: int, seed: int, beyond: float = 0.0) -> torch.Tensor:
    place = torch.rand(count, grid.dimension, generator=_random(seed), dtype=torch.float64)
    lower, upper = torch.tensor(grid.origin), torch.tensor(grid.upper)
    return lower + (place * (1 + 2 * beyond) - beyond) * (upper - lower)


def test_nodes_lie_at_origin_plus_spacing_times_index() -> None:
    grid = GRIDS[0]
    nodes = grid.nodes().reshape(*grid.shape, 3)
    k, j, i = 2, 3, 5
    assert nodes[k, j, i].tolist() == pytest.approx([-1.0 + 0.5 * i, 2.0 + 0.25 * j, 0.5 + 0.2 * k])
    assert nodes[-1, -1, -1].tolist() == pytest.approx(grid.upper)


@pytest.mark.parametrize("grid", GRIDS, ids=["3d", "2d"])
def test_sampling_equals_scipy(grid: Grid) -> None:
    field = torch.randn(grid.shape, generator=_random(0), dtype=torch.float64)
    points = _points(grid, 200, 1)
    axes = [grid.axis(number).numpy() for number in reversed(range(grid.dimension))]
    expected = RegularGridInterpolator(axes, field.numpy())(points.numpy()[:, ::-1])
    np.testing.assert_allclose(grid.sample(field, points), expected, atol=1e-13)


@pytest.mark.parametrize("grid", GRIDS, ids=["3d", "2d"])
@pytest.mark.parametrize("outside", ["clamp", "zero"])
def test_spread_is_the_adjoint_of_sample(grid: Grid, outside: str) -> None:
    points = _points(grid, 300, 2, beyond=0.3)
    field = torch.randn(3, *grid.shape, generator=_random(3), dtype=torch.float64)
    values = torch.randn(3, 300, generator=_random(4), dtype=torch.float64)
    forward = (grid.sample(field, points, outside=outside) * values).sum()
    backward = (grid.spread(values, points, outside=outside) * field).sum()
    assert forward.item() == pytest.approx(backward.item(), rel=1e-13)


def test_linear_fields_are_exact_and_outside_is_clamped() -> None:
    grid = GRIDS[0]
    slope = torch.tensor([2.0, -3.0, 0.5], dtype=torch.float64)
    field = (grid.nodes() @ slope).reshape(grid.shape)
    points = _points(grid, 100, 5)
    torch.testing.assert_close(grid.sample(field, points), points @ slope)
    away = torch.tensor([[9.0, 9.0, 9.0]], dtype=torch.float64)
    assert grid.sample(field, away).item() == pytest.approx(field[-1, -1, -1].item())
    assert grid.sample(field, away, outside="zero").item() == 0.0
    assert not grid.contains(away).any() and grid.contains(points).all()


def test_batches_of_points_meet_the_leading_axes_of_the_field() -> None:
    grid = GRIDS[0]
    field = torch.randn(2, 3, *grid.shape, generator=_random(6), dtype=torch.float64)
    points = torch.stack([_points(grid, 50, 7), _points(grid, 50, 8)])
    together = grid.sample(field, points)
    for member in range(2):
        torch.testing.assert_close(together[member], grid.sample(field[member], points[member]))
    spread = grid.spread(together, grid.stencil(points))
    torch.testing.assert_close(spread[1], grid.spread(together[1], points[1]))


def test_derivatives_with_respect_to_field_and_points() -> None:
    grid = Grid((0.0, 0.0), (1.0, 1.0), (3, 4))
    field = torch.randn(2, 3, 4, generator=_random(9), dtype=torch.float64, requires_grad=True)
    points = torch.tensor([[0.3, 0.4], [1.7, 1.2], [2.4, 0.9]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(grid.sample, (field, points))
    assert torch.autograd.gradcheck(grid.spread, (grid.sample(field, points).detach().requires_grad_(), points))


def test_float32_stays_float32() -> None:
    grid = GRIDS[0]
    field = torch.randn(grid.shape, generator=_random(10), dtype=torch.float64)
    points = _points(grid, 100, 11)
    single = grid.sample(field.float(), points.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), grid.sample(field, points), atol=2e-5, rtol=0)


def test_points_that_are_not_finite_give_values_that_are_not() -> None:
    grid = GRIDS[0]
    points = torch.tensor([[float("nan"), 2.1, 0.6], [0.0, 2.1, 0.6]], dtype=torch.float64)
    values = grid.sample(torch.ones(grid.shape, dtype=torch.float64), points)
    assert values.isnan().tolist() == [True, False]


def test_an_axis_of_one_node_is_constant_along_it() -> None:
    grid = Grid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 2, 2))
    field = torch.arange(4.0, dtype=torch.float64).reshape(1, 2, 2)
    points = torch.tensor([[0.5, 0.5, 3.0], [0.5, 0.5, -3.0]], dtype=torch.float64)
    assert grid.sample(field, points).tolist() == [1.5, 1.5]


def test_refined_padded_and_covering_grids_keep_the_nodes_in_place() -> None:
    grid = Grid((0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3), (11, 11, 11))
    fine = grid.refined(0.5e-3)
    assert fine.shape == (21, 21, 21) and fine.upper == pytest.approx(grid.upper)
    assert grid.refined(0.3e-3).upper[0] >= grid.upper[0]
    wide = grid.padded(2)
    assert wide.shape == (15, 15, 15) and wide.origin[0] == pytest.approx(-2e-3)
    assert Grid.covering((0, 0), (0.01, 0.02), 1e-3).shape == (21, 11)
    assert grid.cell_volume == pytest.approx(1e-9) and grid.size == 1331


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 0), (1, 1, 1), (2, 2, 2)), "all have 2 or all have 3"),
        (((0, 0, 0), (1, 0, 1), (2, 2, 2)), "spacing must be positive"),
        (((0, 0, np.nan), (1, 1, 1), (2, 2, 2)), "origin must be finite"),
        (((0, 0, 0), (1, 1, 1), (2, 0, 2)), "at least one node"),
    ],
)
def test_a_malformed_grid_is_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Grid(*arguments)


def test_malformed_calls_are_refused() -> None:
    grid = GRIDS[0]
    with pytest.raises(ValueError, match=r"points must be \(\.\.\., n, 3\)"):
        grid.sample(torch.zeros(grid.shape), torch.zeros(5, 2))
    with pytest.raises(ValueError, match="last axes must be"):
        grid.sample(torch.zeros(3, 3, 3), torch.zeros(5, 3))
    with pytest.raises(ValueError, match="outside must be one of"):
        grid.sample(torch.zeros(grid.shape), torch.zeros(5, 3), outside="wrap")
    with pytest.raises(ValueError, match="do not fit leading axes"):
        grid.sample(torch.zeros(2, *grid.shape), torch.zeros(3, 5, 3))
    with pytest.raises(ValueError, match="4 points"):
        grid.spread(torch.zeros(5), torch.zeros(4, 3))
    with pytest.raises(ValueError, match="floating point"):
        grid.sample(torch.zeros(grid.shape), torch.zeros(5, 3, dtype=torch.long))
