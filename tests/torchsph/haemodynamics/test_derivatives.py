"""Derivatives inside a mask, at its border and beside a wall, against polynomials and smooth fields."""

from __future__ import annotations

import numpy as np
import pytest
from haemodynamics_cases import ball, on_grid, order, sphere_wall

import geometry
from torchsph.haemodynamics.fields.derivatives import Derivatives, WallSamples


def quadratic(points):
    x, y, z = points.T
    return np.stack([1 + 2 * x - y + x * y, z**2 - 3 * x * z, 0.5 * x**2 + y - z + y * z], 1)


def quadratic_gradient(points):
    x, y, z = points.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = [[2 + y, x - 1, zero], [-3 * z, zero, 2 * z - 3 * x], [x, one + z, y - 1]]
    return np.moveaxis(np.array(rows), -1, 0)


def smooth(points):
    x, y, z = points.T
    return np.stack([np.sin(2 * x) * np.cos(y), np.sin(2 * y + z), np.cos(x - 2 * z)], 1)


def smooth_gradient(points):
    x, y, z = points.T
    zero, slope, last = np.zeros_like(x), np.cos(2 * y + z), np.sin(x - 2 * z)
    rows = [
        [2 * np.cos(2 * x) * np.cos(y), -np.sin(2 * x) * np.sin(y), zero],
        [zero, 2 * slope, slope],
        [-last, zero, 2 * last],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@pytest.mark.parametrize("walled", [False, True])
def test_quadratics_are_exact_up_to_the_border(walled):
    grid, points, mask = ball(0.2)
    fit = Derivatives(grid, mask, sphere_wall(0.2, quadratic) if walled else None)
    gradient = fit.gradient(on_grid(grid, quadratic(points), mask))
    assert fit.unresolved == 0
    np.testing.assert_allclose(gradient, on_grid(grid, quadratic_gradient(points), mask), atol=1e-9)
    laplacian = fit.laplacian(on_grid(grid, quadratic(points), mask))
    np.testing.assert_allclose(laplacian[:, mask].T, np.tile([0.0, 2.0, 1.0], (mask.sum(), 1)), atol=1e-7)


@pytest.mark.parametrize("walled", [False, True])
def test_second_order_everywhere(walled):
    spacings, errors = [0.2, 0.1, 0.05], []
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        fit = Derivatives(grid, mask, sphere_wall(spacing, smooth) if walled else None)
        gradient = fit.gradient(on_grid(grid, smooth(points), mask))
        errors.append(np.abs(gradient - on_grid(grid, smooth_gradient(points), mask)).max())
    assert order(spacings, errors) > 1.75
    assert errors[-1] < 0.03


def test_the_wall_steadies_the_border():
    """Noise of the nodes enters one-sided fits strongly; the wall's samples have none of it."""
    grid, _, mask = ball(0.15)
    noise = np.random.default_rng(0).normal(size=(3, *grid.shape)) * mask
    still = sphere_wall(0.15, np.zeros_like)
    alone, walled = (Derivatives(grid, mask, wall).gradient(noise)[:, :, mask] for wall in (None, still))
    border = ~(alone == walled).all((0, 1))
    assert 0.2 < border.mean() < 0.8
    assert np.std(walled[..., border]) < 0.7 * np.std(alone[..., border])


def test_members_and_single_fields_agree_in_bits():
    grid, points, mask = ball(0.25)
    fit = Derivatives(grid, mask, sphere_wall(0.25, smooth))
    field = on_grid(grid, smooth(points), mask)
    both = fit.gradient(np.stack([field, 2 * field]))
    assert (both[0] == fit.gradient(field)).all()


def test_what_lies_outside_the_mask_does_not_enter():
    grid, points, mask = ball(0.25)
    field = on_grid(grid, smooth(points), mask)
    fit = Derivatives(grid, mask)
    assert (fit.gradient(np.where(mask, field, np.nan)) == fit.gradient(field)).all()


def test_a_plane_and_uneven_spacing():
    grid = geometry.Grid((0.0, 0.0), (0.1, 0.25), (9, 12))
    x, y = grid.nodes().numpy().T
    field = np.stack([x * y, x**2 - y]).reshape(2, *grid.shape)
    gradient = Derivatives(grid, np.ones(grid.shape, bool)).gradient(field).reshape(2, 2, -1)
    np.testing.assert_allclose(gradient, [[y, x], [2 * x, -np.ones_like(x)]], atol=1e-9)
    assert np.allclose(Derivatives(grid, np.ones(grid.shape, bool)).divergence(field).ravel(), y - 1)


def test_a_node_on_its_own_has_no_derivative_and_is_counted():
    grid = geometry.Grid((0.0,) * 3, (1.0,) * 3, (7, 7, 7))
    mask = np.zeros(grid.shape, bool)
    mask[3, 3, 3] = True
    fit = Derivatives(grid, mask)
    assert not fit.gradient(np.ones((3, *grid.shape))).any() and fit.unresolved == 1


def test_a_single_layer_along_a_wall_feels_the_shear():
    """One layer of nodes between plates: only the wall samples know that the velocity changes across it."""
    grid = geometry.Grid((0.0,) * 3, (1.0,) * 3, (7, 7, 7))
    mask = np.zeros(grid.shape, bool)
    mask[3] = True
    x, y = np.meshgrid(np.arange(7.0), np.arange(7.0))
    floor = np.stack([x.ravel(), y.ravel(), np.full(49, 2.5)], 1)
    wall = WallSamples(floor, np.zeros((49, 3)))
    velocity = np.zeros((3, *grid.shape))
    velocity[0, 3] = 0.5  # shear rate 1 above z = 2.5
    assert np.allclose(Derivatives(grid, mask, wall).gradient(velocity)[0, 2][mask], 1.0)


def test_a_mask_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="mask must be"):
        Derivatives(geometry.Grid((0.0,) * 3, (1.0,) * 3, (4, 5, 6)), np.ones((4, 5, 5), bool))
