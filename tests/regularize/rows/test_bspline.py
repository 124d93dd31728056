"""The basis against definitions and autodiff: partition of unity, derivatives, continuity, scipy."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from regularize import InvalidInput, Knots, basis
from regularize.basis.bspline import interval_gram


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_partition_of_unity_and_positivity(degree):
    t = torch.linspace(0, 1, 21, dtype=torch.float64)
    values = basis(t, degree)
    assert values.shape == (21, degree + 1)
    assert torch.allclose(values.sum(-1), torch.ones_like(t), atol=1e-14)
    assert (values >= -1e-15).all()


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_equals_scipy(degree):
    t = torch.linspace(0, 0.999, 11, dtype=torch.float64)
    knots = np.arange(-degree, degree + 2, dtype=float)
    for i in range(degree + 1):
        element = BSpline.basis_element(knots[i : i + degree + 2], extrapolate=False)
        assert np.allclose(basis(t, degree)[:, i].numpy(), element(t.numpy()), atol=1e-13)


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_equal_autodiff(degree, order):
    t = torch.linspace(0.05, 0.95, 9, dtype=torch.float64, requires_grad=True)
    for i in range(degree + 1):
        value = basis(t, degree)[:, i]
        for _ in range(order):
            (value,) = torch.autograd.grad(value.sum(), t, create_graph=True)
        assert torch.allclose(value, basis(t, degree, order)[:, i], atol=1e-12)


@pytest.mark.parametrize("degree", [2, 3, 4, 5])
def test_pieces_join_with_continuous_derivatives(degree):
    ends = torch.tensor([1.0, 0.0], dtype=torch.float64)
    for order in range(degree):
        right, left = basis(ends, degree, order)
        # function i at the end of one interval is function i - 1 at the start of the next
        assert torch.allclose(right[1:], left[:-1], atol=1e-13)


def test_cubic_is_the_thesis_formula():
    t = torch.tensor([0.3], dtype=torch.float64)
    distance = torch.tensor([1.3, 0.3, 0.7, 1.7], dtype=torch.float64)  # to the four nodes, eq. 2.39
    near = 2 / 3 - distance**2 + distance**3 / 2
    far = (2 - distance) ** 3 / 6
    assert torch.allclose(basis(t, 3)[0], torch.where(distance < 1, near, far), atol=1e-14)


def test_gram_equals_quadrature():
    t = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
    a, b = basis(t, 3, 2), basis(t, 3, 1)
    assert np.allclose(interval_gram(3, 2, 1), (a.T @ b / 20000).numpy(), atol=1e-6)


def test_degree_out_of_range_is_refused():
    with pytest.raises(InvalidInput, match="degree"):
        basis(torch.zeros(1), 6)


@pytest.mark.parametrize("axes", [2, 3])
def test_knots_stencil_matches_direct_products(axes):
    knots = Knots.covering((0.0,) * axes, (5.0, 3.0, 2.0)[:axes], (1.0, 0.5, 0.7)[:axes])
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(50, axes, generator=generator, dtype=torch.float64) * torch.tensor((5.0, 3.0, 2.0)[:axes])
    assert knots.inside(points).all()
    cell, t = knots.locate(points)
    dense = torch.zeros(50, knots.nodes, dtype=torch.float64)
    dense.scatter_(1, knots.local_nodes(cell), knots.stencil(t))
    assert torch.allclose(dense.sum(1), torch.ones(50, dtype=torch.float64))
    # Greville: cubic coefficients equal to node positions reproduce the coordinate, array order z, y, x
    for axis in range(axes):
        nodes = torch.arange(knots.cells[axis] + 3, dtype=torch.float64) - 1
        where = knots.origin[axis] + knots.spacing[axis] * nodes
        view = [1] * axes
        view[axes - 1 - axis] = -1
        c = where.view(view).expand(knots.shape).flatten()
        assert torch.allclose(dense @ c, points[:, axis], atol=1e-12)


def test_points_on_and_beyond_the_faces():
    knots = Knots((0.0, 0.0), (1.0, 1.0), (3, 2))
    points = torch.tensor([[3.0, 2.0], [0.0, 0.0], [3.1, 1.0]])
    assert knots.inside(points).tolist() == [True, True, False]
    cell, t = knots.locate(points)
    assert cell[0].tolist() == [2, 1] and t[0].tolist() == [1.0, 1.0]
