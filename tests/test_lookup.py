"""Look-ups between two moments: SciPy's interpolation in space, linear in time, edges continued."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from geometry import Grid
from torchsph.lookup import LookUp


@pytest.mark.parametrize("shape", [(7, 9), (6, 5, 8)], ids=["plane", "volume"])
def test_values_are_those_of_scipy_between_two_moments(shape):
    generator = torch.Generator().manual_seed(3)
    d = len(shape)
    grid = Grid(origin=tuple(0.5 - k for k in range(d)), spacing=tuple(0.5 + 0.25 * k for k in range(d)), shape=shape)
    early, late = (torch.randn((4, *shape), generator=generator, dtype=torch.float64) for _ in range(2))
    points = torch.rand((50, d), generator=generator, dtype=torch.float64) * 8.0 - 2.0  # some beyond the grid
    fraction = torch.rand(50, generator=generator, dtype=torch.float64)
    got = LookUp(grid, early, late, 1.0).at(points, fraction)
    place = ((points.numpy() - np.array(grid.origin)) / np.array(grid.spacing)).T[::-1]
    both = [np.stack([map_coordinates(c, place, order=1, mode="nearest") for c in f.numpy()], 1) for f in (early, late)]
    share = fraction.numpy()[:, None]
    np.testing.assert_allclose(got.numpy(), (1 - share) * both[0] + share * both[1], atol=1e-12)
    steady = LookUp(grid, early, early, 1.0).at(points, fraction)
    np.testing.assert_allclose(steady.numpy(), both[0], atol=1e-12)


def test_a_point_that_is_not_finite_gets_no_finite_value():
    grid = Grid(origin=(0.0, 0.0), spacing=(1.0, 1.0), shape=(3, 3))
    field = torch.ones((1, 3, 3))
    got = LookUp(grid, field, field, 1.0).at(torch.tensor([[float("nan"), 1.0], [1.0, 1.0]]), torch.zeros(()))
    assert torch.isnan(got[0]).all() and got[1, 0] == 1.0
