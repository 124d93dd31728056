"""The assembled normal matrix and its solution against dense algebra."""

import pytest
import torch
from regularize_cases import blocks_of, make

from regularize import Factor, InvalidInput, Knots, System, VectorRows, lsqr, solve_direct


def dense_of(system):
    eye = torch.eye(system.unknowns, dtype=torch.float64)
    return torch.stack([system.matvec(column) for column in eye], dim=1)


@pytest.mark.parametrize("axes,degree", [(2, 3), (3, 2), (3, 3), (2, 1)])
def test_direct_and_lsqr_equal_dense_least_squares(axes, degree):
    knots, blocks = blocks_of(axes, degree)
    system = System(knots, axes, list(blocks.values()), 0.3)
    a, b = dense_of(system), system.target()
    normal = a.T @ a + 0.09 * torch.eye(system.unknowns, dtype=torch.float64)
    dense = torch.linalg.solve(normal, a.T @ b)
    direct, _ = solve_direct(system, tolerance=1e-12)
    assert torch.allclose(direct.x, dense, atol=1e-11)
    iterative = lsqr(system.matvec, system.rmatvec, b, damping=0.3, tolerance=1e-11)
    assert torch.allclose(iterative.x, dense, atol=1e-8)


def test_factor_serves_many_right_hand_sides():
    knots, blocks = blocks_of(2)
    system = System(knots, 2, list(blocks.values()), 0.3)
    factor = Factor(system)
    right = torch.stack([system.right_side(), 2 * system.right_side()], dim=1)
    both = factor.solve(right)
    assert torch.allclose(both[:, 1], 2 * both[:, 0]) and torch.allclose(
        both[:, 0], factor.solve(right[:, 0])
    )


def test_coefficients_without_rows_stay_zero():
    knots = Knots((0.0, 0.0), (1.0, 1.0), (20, 3))
    _, _, draw, weight, _ = make(2)
    points = torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2
    system = System(knots, 2, [VectorRows(knots, points, draw, weight[:, None])], 0.1)
    x = solve_direct(system)[0].x.view(*knots.shape, 2)
    assert float(x[:, 6:].abs().max()) == 0 and float(x[:5, :5].abs().min()) > 0


def test_singular_system_is_named():
    knots, points, draw, weight, _ = make(2, n=3)
    system = System(knots, 2, [VectorRows(knots, points, draw, weight[:, None])], 0.0)
    with pytest.raises(InvalidInput, match="curvature or damping"):
        solve_direct(system)
