"""Kinetic energy and dissipation against rigid rotation, Taylor-Green and Couette, and what a mean field hides."""

from __future__ import annotations

import numpy as np
import pytest
from haemodynamics_cases import ball, on_grid, order
from scipy.ndimage import gaussian_filter

import geometry
from torchsph.haemodynamics.energy import dissipation, energy_loss, kinetic_energy
from torchsph.haemodynamics.fields.derivatives import Derivatives

RHO, MU = 1060.0, 0.004


def test_a_ball_in_rigid_rotation():
    """Energy 1/2 I w^2 with I = 2/5 m R^2; nothing dissipates."""
    errors, spacings = [], [0.2, 0.1, 0.05]
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        velocity = on_grid(grid, np.cross([0.0, 0.0, 2.0], points), mask)
        ball_volume = 4 / 3 * np.pi
        exact = 0.5 * 0.4 * RHO * ball_volume * 2.0**2
        errors.append(abs(kinetic_energy(velocity, mask, grid.cell_volume, RHO, volume=ball_volume) / exact - 1).item())
        gradient = Derivatives(grid, mask).gradient(velocity)
        assert energy_loss(gradient, mask, grid.cell_volume, MU) == pytest.approx(0, abs=1e-12)
    assert errors[-1] < 0.01 and order(spacings, errors) > 1


def test_dissipation_of_taylor_green_is_its_loss_of_energy():
    """du/dt = nu lap u = -2 nu k^2 u: over a period the energy falls by 4 nu k^2 of itself a second."""
    errors, counts = [], [16, 32, 64]
    for count in counts:
        grid = geometry.Grid((0.0, 0.0), (2 * np.pi / count,) * 2, (count + 5, count + 5))
        x, y = grid.nodes().numpy().T
        flow = np.stack([-np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)]).reshape(2, *grid.shape)
        gradient = Derivatives(grid, np.ones(grid.shape, bool)).gradient(flow)
        period = np.zeros(grid.shape, bool)
        period[2 : 2 + count, 2 : 2 + count] = True
        loss = energy_loss(gradient, period, grid.cell_volume, MU)
        energy = kinetic_energy(flow, period, grid.cell_volume, RHO)
        errors.append(abs(loss / (4 * MU / RHO * energy) - 1).item())
    assert order([1 / count for count in counts], errors) > 1.9 and errors[-1] < 5e-3


def test_members_are_a_batch_axis():
    grid, points, mask = ball(0.3)
    velocity = on_grid(grid, np.cross([0.0, 0.0, 2.0], points), mask)
    both = kinetic_energy(np.stack([velocity, 2 * velocity]), mask, grid.cell_volume, RHO)
    assert both.shape == (2,) and both[1] == pytest.approx(4 * both[0])


def test_the_variance_returns_what_the_mean_hides():
    """Members = mean + noise of known deviation: their mean energy and dissipation, from mean and deviation alone."""
    grid = geometry.Grid((0.0,) * 3, (1e-3,) * 3, (24, 24, 24))
    generator, length, sigma = np.random.default_rng(3), 2.5e-3, 0.1
    noise = gaussian_filter(
        generator.normal(size=(24, 3, 40, 40, 40)), (0, 0, 2.5 / 2**0.5, 2.5 / 2**0.5, 2.5 / 2**0.5)
    )
    noise = noise[..., 8:-8, 8:-8, 8:-8]
    noise = sigma * noise / noise.std()
    mean = np.zeros((3, *grid.shape)) + 0.05
    mask = np.ones(grid.shape, bool)
    deviation = np.full_like(mean, sigma)
    members = kinetic_energy(mean + noise, mask, grid.cell_volume, RHO).mean()
    assert kinetic_energy(mean, mask, grid.cell_volume, RHO, sigma=deviation) == pytest.approx(members, rel=0.05)
    fit = Derivatives(grid, mask)
    inner = np.zeros_like(mask)
    inner[2:-2, 2:-2, 2:-2] = True
    lost = energy_loss(fit.gradient(noise), inner, grid.cell_volume, MU).mean()
    density = dissipation(fit.gradient(mean), inner, MU, deviation, length)
    # central differences over two nodes see 1 - (1 - exp(-2 h^2 / L^2)) / (2 h^2 / L^2) less of a Gaussian correlation
    seen = (1 - np.exp(-2 * 0.4**2)) / (2 * 0.4**2)
    assert seen * density.sum() * grid.cell_volume == pytest.approx(lost, rel=0.06)


def test_a_deviation_without_its_length_is_refused():
    with pytest.raises(ValueError, match="together"):
        dissipation(np.zeros((3, 3, 4, 4, 4)), np.ones((4, 4, 4)), MU, np.ones((3, 4, 4, 4)))
    with pytest.raises(ValueError, match="no node"):
        kinetic_energy(np.zeros((3, 4, 4, 4)), np.zeros((4, 4, 4)), 1.0, RHO)
