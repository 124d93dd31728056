"""Look-ups between two times: SciPy's interpolation in space, linear in time, edges continued."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from geometry import Grid
from torchsph.simulator.walls.look_up import LookUp, by_node, rows_of


@pytest.mark.parametrize("shape", [(7, 9), (6, 5, 8)], ids=["plane", "volume"])
def test_values_are_those_of_scipy_between_two_times(shape):
    generator = torch.Generator().manual_seed(3)
    d = len(shape)
    grid = Grid(origin=tuple(0.5 - k for k in range(d)), spacing=tuple(0.5 + 0.25 * k for k in range(d)), shape=shape)
    early, late = (torch.randn((4, *shape), generator=generator, dtype=torch.float64) for _ in range(2))
    points = torch.rand((50, d), generator=generator, dtype=torch.float64) * 8.0 - 2.0  # some beyond the grid
    fraction = torch.rand(50, generator=generator, dtype=torch.float64)
    looked = LookUp(grid, early, late, 1.0)
    got = looked.at(points, fraction)
    place = ((points.numpy() - np.array(grid.origin)) / np.array(grid.spacing)).T[::-1]
    both = [np.stack([map_coordinates(c, place, order=1, mode="nearest") for c in f.numpy()], 1) for f in (early, late)]
    share = fraction.numpy()[:, None]
    np.testing.assert_allclose(got.numpy(), (1 - share) * both[0] + share * both[1], atol=1e-12)
    np.testing.assert_allclose(looked._by_torch(points, fraction).numpy(), got.numpy(), atol=1e-12)
    steady = LookUp(grid, early, early, 1.0).at(points, fraction)
    np.testing.assert_allclose(steady.numpy(), both[0], atol=1e-12)


def test_a_point_that_is_not_finite_gets_no_finite_value():
    grid = Grid(origin=(0.0, 0.0), spacing=(1.0, 1.0), shape=(3, 3))
    field = torch.ones((1, 3, 3))
    got = LookUp(grid, field, field, 1.0).at(torch.tensor([[float("nan"), 1.0], [1.0, 1.0]]), torch.zeros(()))
    assert torch.isnan(got[0]).all() and got[1, 0] == 1.0


def test_derivatives_go_through_torch_and_agree_with_differences():
    grid = Grid(origin=(0.0, 0.0), spacing=(1.0, 0.5), shape=(4, 5))
    field = torch.randn((2, 4, 5), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    looked = LookUp(grid, field, field + 1.0, 1.0)
    points = torch.tensor([[1.3, 0.7], [2.6, 0.2]], dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(lambda p: looked.at(p, torch.tensor(0.4, dtype=torch.float64)), (points,))


def test_a_field_laid_out_by_node_is_read_without_a_copy():
    field = torch.randn((3, 4, 5), generator=torch.Generator().manual_seed(2))
    laid = by_node(field)
    torch.testing.assert_close(laid, field)
    assert rows_of(laid).data_ptr() == laid.data_ptr()


def test_plain_cells_take_their_lowest_corner():
    grid = Grid(origin=(0.0, 0.0), spacing=(1.0, 1.0), shape=(5, 6))
    field = torch.arange(30.0).reshape(1, 5, 6)
    looked = LookUp(grid, field, field + 1.0, 1.0, plain=12.5)
    got = looked.at(torch.tensor([[1.4, 0.3], [1.4, 2.3], [0.5, 2.5], [3.9, 3.9]]), torch.tensor(0.5))[:, 0]
    # 13 is the first corner above the bound; above it no cell is interpolated, in space or in time
    np.testing.assert_allclose(got, [1.4 + 6 * 0.3 + 0.5, 13.0, 0.5 + 6 * 2.5 + 0.5, 21.0], rtol=1e-6)
