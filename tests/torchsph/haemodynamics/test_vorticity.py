"""Vorticity, helicity, Q and lambda2 against rigid rotation, shear, strain, Hill's vortex and a Beltrami flow."""

from __future__ import annotations

import numpy as np
import pytest
from haemodynamics_cases import ball, hill_vortex, hill_vorticity, on_grid, order, sphere_wall

from torchsph.haemodynamics.fields.derivatives import Derivatives
from torchsph.haemodynamics.vorticity import helicity_density, lambda2, q_criterion, vorticity


def uniform(matrix):
    return np.asarray(matrix, float)[:, :, None, None, None]


def test_rigid_rotation():
    spin = np.array([1.0, -2.0, 3.0])
    grid, points, mask = ball(0.25)
    gradient = Derivatives(grid, mask).gradient(on_grid(grid, np.cross(spin, points), mask))
    np.testing.assert_allclose(vorticity(gradient)[:, mask].T, np.tile(2 * spin, (mask.sum(), 1)), atol=1e-9)
    # of rigid rotation Q = abs(spin)^2 and lambda2 = -abs(spin)^2
    np.testing.assert_allclose(q_criterion(gradient)[mask], 14.0, atol=1e-8)
    np.testing.assert_allclose(lambda2(gradient)[mask], -14.0, atol=1e-8)


def test_shear_is_no_vortex_and_strain_less():
    assert q_criterion(uniform([[0, 1, 0], [0, 0, 0], [0, 0, 0]])).item() == 0
    assert lambda2(uniform([[0, 1, 0], [0, 0, 0], [0, 0, 0]])).item() == pytest.approx(0, abs=1e-15)
    assert q_criterion(uniform([[1, 0, 0], [0, -1, 0], [0, 0, 0]])).item() == pytest.approx(-1)
    assert lambda2(uniform([[1, 0, 0], [0, -1, 0], [0, 0, 0]])).item() == pytest.approx(1)


def test_in_a_plane_lambda2_is_minus_q():
    rotation = np.array([[0.3, -2.0], [1.0, -0.3]])[:, :, None, None]
    assert lambda2(rotation).item() == pytest.approx(-q_criterion(rotation).item())
    assert vorticity(rotation).item() == pytest.approx(3.0)


def test_hills_vortex_converges():
    spacings, errors = [0.2, 0.1, 0.07], []
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        fit = Derivatives(grid, mask, sphere_wall(spacing, hill_vortex))
        curl = vorticity(fit.gradient(on_grid(grid, hill_vortex(points), mask)))
        errors.append(np.abs(curl - on_grid(grid, hill_vorticity(points), mask)).max())
    assert errors[-1] < 1e-9  # its velocity is quadratic: exact at every spacing, up to the border


def test_helicity_of_a_beltrami_flow_converges():
    """The ABC flow of A = B = C = 1 is its own curl (Dombre et al. 1986), so that its helicity is abs(u)^2."""
    spacings, errors = [0.2, 0.1, 0.07], []
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        x, y, z = points.T
        flow = np.stack([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)], 1)
        velocity = on_grid(grid, flow, mask)
        curl = vorticity(Derivatives(grid, mask).gradient(velocity))
        errors.append(np.abs(helicity_density(velocity, curl) - (velocity**2).sum(0)).max())
    assert order(spacings, errors) > 1.75 and errors[-1] < 0.02


def test_axes_that_are_no_gradient_are_refused():
    with pytest.raises(ValueError, match="velocity gradient"):
        vorticity(np.zeros((3, 4, 4, 4)))
