"""Cubic splines on grids, against SciPy's, against polynomials, and their order."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

import geometry
from geometry.grids.cubic import CubicInterpolation


def points_in(grid, count, seed=0):
    draw = torch.Generator().manual_seed(seed)
    lower, upper = torch.tensor(grid.origin).double(), torch.tensor(grid.upper).double()
    return lower + (upper - lower) * torch.rand((count, grid.dimension), generator=draw, dtype=torch.float64)


@pytest.mark.parametrize("shape", [(5, 7), (4, 6, 5), (2, 9), (1, 4, 3)])
def test_is_the_spline_of_scipy(shape):
    grid = geometry.Grid((0.01, -0.02, 0.3)[: len(shape)], (2e-3, 1e-3, 5e-4)[: len(shape)], shape)
    field = torch.randn((2, *shape), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = points_in(grid, 200)
    place = grid.locate(points).numpy().T[::-1]
    found = CubicInterpolation(grid, field).at(points)
    for one, values in zip(field.numpy(), found.numpy(), strict=True):
        # SciPy has its own way with axes of one node
        kept = [axis for axis, count in enumerate(shape) if count > 1]
        wanted = map_coordinates(one.squeeze(), [place[axis] for axis in kept], order=3, mode="mirror")
        np.testing.assert_allclose(values, wanted, atol=1e-12)


def test_meets_the_nodes_and_stays_at_the_edge_beyond_the_box():
    grid = geometry.Grid((0.0, 0.0), (1e-3, 1e-3), (6, 5))
    field = torch.randn((1, 6, 5), generator=torch.Generator().manual_seed(2), dtype=torch.float32)
    spline = CubicInterpolation(grid, field)
    torch.testing.assert_close(spline.at(grid.nodes()).reshape(field.shape), field, atol=1e-6, rtol=0)
    outside = torch.tensor([[-1.0, 2e-3], [9.0, 9.0]], dtype=torch.float64)
    torch.testing.assert_close(spline.at(outside)[0], torch.stack([field[0, 2, 0], field[0, 5, 4]]))


def test_is_of_fourth_order():
    errors = []
    for count in (17, 33):
        grid = geometry.Grid((0.0, 0.0), (np.pi / (count - 1),) * 2, (count, count))
        wave = torch.cos(3 * grid.nodes()).prod(1)  # even about the ends, as the mirror is
        points = points_in(grid, 500)
        found = CubicInterpolation(grid, wave.reshape(grid.shape)).at(points)
        errors.append(float((found - torch.cos(3 * points).prod(1)).square().mean().sqrt()))
    assert 14 < errors[0] / errors[1] < 18


def test_a_field_of_another_grid_is_refused():
    with pytest.raises(ValueError, match=r"field must end in the grid's \(6, 5\), not \(1, 5, 6\)"):
        CubicInterpolation(geometry.Grid((0.0, 0.0), (1.0, 1.0), (6, 5)), torch.zeros(1, 5, 6))
