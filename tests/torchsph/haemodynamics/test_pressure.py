"""Pressure from momentum against exact flows: rotation, Taylor-Green, Womersley, an ellipsoid that is squeezed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from haemodynamics_cases import ball, on_grid, order, sphere_wall

import geometry
from torchsph.haemodynamics.fields.acceleration import (
    difference_weights,
    material_acceleration,
    pressure_gradient,
    time_derivative,
)
from torchsph.haemodynamics.fields.derivatives import Derivatives, WallSamples
from torchsph.haemodynamics.force import axial_components, haemodynamic_force
from torchsph.haemodynamics.pressure import PressureSolver, pressure_difference, region_mean
from torchsph.validation.exact_wall_flows import womersley

RHO, MU = 1060.0, 0.004


def without_mean(field, mask):
    return (field[..., mask] - field[..., mask].mean(-1, keepdims=True)).T


def test_rigid_rotation():
    """p = rho w^2 r^2 / 2: quadratic, and central differences and the trapezoidal rule are exact for it."""
    grid, points, mask = ball(0.2)
    velocity = on_grid(grid, np.cross([0.0, 0.0, 2.0], points), mask)
    carried = material_acceleration(velocity, Derivatives(grid, mask).gradient(velocity), None)
    pressure = PressureSolver(grid, mask).solve(pressure_gradient(carried, None, RHO, MU))
    exact = on_grid(grid, 0.5 * RHO * 4.0 * (points[:, 0] ** 2 + points[:, 1] ** 2), mask)
    np.testing.assert_allclose(without_mean(pressure, mask), without_mean(exact, mask), rtol=1e-9, atol=1e-7)


def test_taylor_green_inside_a_circle_converges():
    """Any closed curve serves: p / rho = -1/4 (cos 2x + cos 2y) for u = (-cos x sin y, sin x cos y)."""
    spacings, errors = [0.2, 0.1, 0.05], []
    for spacing in spacings:
        count = int(3 / spacing)
        grid = geometry.Grid((-1.47, -1.41), (spacing, spacing), (count, count))
        x, y = grid.nodes().numpy().T
        mask = (x**2 + y**2 < 1.2**2).reshape(grid.shape)
        velocity = np.stack([-np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)]).reshape(2, *grid.shape) * mask
        fit = Derivatives(grid, mask)
        # the flow decays: du/dt = nu lap u, and both cancel
        carried = material_acceleration(velocity, fit.gradient(velocity), None)
        pressure = PressureSolver(grid, mask).solve(pressure_gradient(carried, None, 1.0, 0.0))
        exact = (-0.25 * (np.cos(2 * x) + np.cos(2 * y))).reshape(grid.shape)
        errors.append(np.abs(without_mean(pressure, mask) - without_mean(exact, mask)).max())
    assert order(spacings, errors) > 1.75 and errors[-1] < 2e-3


def squeezed(points, time):
    """u_i = a_i(t) x_i inside an ellipsoid with axes exp(integral of a_i): divergence-free for a_1 + a_2 + a_3 = 0."""
    rate = np.array([1.0, 0.5, -1.5]) * np.cos(3 * time)
    return rate * points


def test_a_squeezed_ellipsoid_converges_in_time_and_is_exact_in_space():
    """p = -rho / 2 sum (a_i' + a_i^2) x_i^2; quadratic in space, so that only frames are left to converge."""
    grid, points, _ = ball(0.25)
    steps, errors = [0.04, 0.02, 0.01], []
    for step in steps:
        times = 0.3 + step * np.arange(-2, 3)
        axes = [np.exp(np.array([1.0, 0.5, -1.5]) * np.sin(3 * t) / 3) for t in times]
        masks = np.stack([((points / a) ** 2).sum(1) < 0.8**2 for a in axes]).reshape(-1, *grid.shape)
        fields = np.stack([on_grid(grid, squeezed(points, t), m) for t, m in zip(times, masks, strict=True)])
        rate = time_derivative(fields, masks, times, 2)
        carried = material_acceleration(fields[2], Derivatives(grid, masks[2]).gradient(fields[2]), rate)
        pressure = PressureSolver(grid, masks[2]).solve(pressure_gradient(carried, None, RHO, MU))
        base = np.array([1.0, 0.5, -1.5])
        factor = -3 * base * np.sin(0.9) + (base * np.cos(0.9)) ** 2
        exact = on_grid(grid, -0.5 * RHO * (factor * points**2).sum(1), masks[2])
        errors.append(np.abs(without_mean(pressure, masks[2]) - without_mean(exact, masks[2])).max() / np.ptp(exact))
        assert (masks[1:4].any(0) & ~masks[1:4].all(0)).any()  # the wall does pass nodes
    assert order(steps, errors) > 1.8 and errors[-1] < 1e-3


def test_womersley_pressure_gradient():
    """Oscillating flow in a pipe: grad p = -rho f cos(wt), uniform, out of accelerations and viscous forces."""
    radius, mu, force, frequency, time = 0.01, 0.08, 2.0, 2.0, 0.05  # a shear layer of 2.4 mm
    spacings, errors = [1.25e-3, 8e-4, 5e-4], []
    for spacing in spacings:
        half = int(radius / spacing) + 2
        grid = geometry.Grid((-(half - 0.37) * spacing,) * 2 + (0.0,), (spacing,) * 3, (7, 2 * half, 2 * half))
        points = grid.nodes().numpy()
        distance = np.hypot(points[:, 0], points[:, 1])
        mask = (distance < radius).reshape(grid.shape)

        def flow(t, distance=distance, grid=grid, mask=mask):
            along = womersley(torch.from_numpy(distance), t, mu / RHO, force, frequency, radius).numpy()
            field = np.zeros((3, *grid.shape))
            field[2] = along.reshape(grid.shape) * mask
            return field

        angle = np.arange(0, 2 * np.pi, spacing / radius)
        ring = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
        height = np.arange(-2, 9) * spacing
        wall = np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in height])
        fit = Derivatives(grid, mask, WallSamples(wall, np.zeros_like(wall)))
        step = 1e-4
        frames = np.stack([flow(time - step), flow(time), flow(time + step)])
        rate = time_derivative(frames, np.stack([mask] * 3), time + step * np.array([-1.0, 0.0, 1.0]), 1)
        carried = material_acceleration(frames[1], fit.gradient(frames[1]), rate)
        gradient = pressure_gradient(carried, fit.laplacian(frames[1]), RHO, mu)
        pressure = PressureSolver(grid, mask).solve(gradient)
        layers = pressure.reshape(7, -1)[:, mask[0].ravel()].mean(1)
        found = (layers[-1] - layers[0]) / (6 * spacing)
        exact = -RHO * force * np.cos(2 * np.pi * frequency * time)
        errors.append(abs(found / exact - 1))
    assert order(spacings, errors) > 0.9 and errors[-1] < 0.02


def test_the_part_that_is_no_gradient_drops_out():
    grid, points, mask = ball(0.2)
    still = PressureSolver(grid, mask).solve(np.zeros((3, *grid.shape)))
    swirl = on_grid(grid, np.cross([0.0, 0.0, 1.0], points), mask)
    slope = on_grid(grid, np.tile([1.0, 2.0, 3.0], (len(points), 1)), mask)
    both = PressureSolver(grid, mask).solve(np.stack([slope, slope + swirl]))
    assert not still.any()
    assert np.abs(both[1] - both[0])[mask].max() < 0.05 * np.ptp(both[0][mask])


def test_each_part_has_its_own_gauge():
    grid = geometry.Grid((0.0,) * 3, (1.0,) * 3, (3, 3, 7))
    mask = np.ones(grid.shape, bool)
    mask[..., 3] = False
    gradient = np.zeros((3, *grid.shape))
    gradient[0] = 2.0
    pressure = PressureSolver(grid, mask).solve(gradient)
    np.testing.assert_allclose(pressure[0, 0], [-2, 0, 2, 0, -2, 0, 2], atol=1e-12)


def test_difference_between_two_places():
    grid, points, mask = ball(0.1)
    pressure = on_grid(grid, 3.0 * points[:, 2], mask)
    found = pressure_difference(pressure, mask, grid, [0, 0, 0.6], [0, 0, -0.6], 0.15)
    assert found == pytest.approx(3.6, rel=0.03)
    assert region_mean(pressure, mask, grid, [0, 0, 5.0], 0.1) == pytest.approx(3.0, rel=0.1)


def test_difference_weights_are_exact_for_polynomials():
    times = np.array([0.0, 0.01, 0.03, 0.04, 0.07])
    for power in range(5):
        found = difference_weights(times, 0.03) @ times**power
        assert found == pytest.approx(0.0 if power == 0 else power * 0.03 ** (power - 1), abs=1e-9)


def test_differences_do_not_cross_an_event():
    times = np.arange(5) * 0.01
    velocity = np.maximum(times - 0.015, 0.0)[:, None, None, None, None] * np.ones((1, 3, 2, 2, 2))
    mask = np.ones((5, 2, 2, 2), bool)
    assert np.allclose(time_derivative(velocity, mask, times, 2), 0.75)
    assert np.allclose(time_derivative(velocity, mask, times, 2, events=[0.015]), 1.0)
    assert np.allclose(time_derivative(velocity, mask, times, 1, events=[0.015]), 0.0)


def test_force_of_a_uniform_acceleration():
    grid, points, mask = ball(0.25)
    acceleration = on_grid(grid, np.tile([0.0, 3.0, 4.0], (len(points), 1)), mask)
    force = haemodynamic_force(acceleration, mask, grid.cell_volume, RHO, volume=2.0)
    assert force == pytest.approx([0, 3 * RHO * 2, 4 * RHO * 2])
    along, across = axial_components(force, [0, 0, 2.0])
    assert along == pytest.approx(8 * RHO) and across == pytest.approx(6 * RHO)


def test_wrong_gradients_are_refused():
    grid, _, mask = ball(0.3)
    with pytest.raises(ValueError, match="must be"):
        PressureSolver(grid, mask).solve(np.zeros((2, *grid.shape)))
    with pytest.raises(ValueError, match="not finite"):
        PressureSolver(grid, mask).solve(np.full((3, *grid.shape), np.nan))
    with pytest.raises(ValueError, match="no node"):
        PressureSolver(grid, np.zeros(grid.shape))
    assert sphere_wall(0.3, np.zeros_like).points.shape[1] == 3
