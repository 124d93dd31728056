"""What the measurement's kernel takes once more is the least that it took, in spectra that flows have."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import geometry
from geometry.grids.fields import fwhm_to_deviation, masked_blur
from torchsph.haemodynamics import unresolved
from torchsph.methods.measurement.wall_balance import WallBalance
from torchsph.methods.members.resolution import Resolution

STEP, SIZE = 1e-3, 48
KERNEL = 3e-3


@pytest.fixture(scope="module")
def filling() -> geometry.Recording:
    return geometry.Ventricle().recording([0.28, 0.30, 0.32], grid_spacing=2e-3, wall_spacing=2e-3)


def box() -> geometry.Recording:
    grid = geometry.Grid((0.0, 0.0, 0.0), (STEP,) * 3, (SIZE,) * 3)
    still = np.zeros((1, 3, SIZE, SIZE, SIZE), np.float32)
    return geometry.Recording(np.zeros(1), grid, still, np.ones((1, SIZE, SIZE, SIZE), bool), None, rho=1060.0, mu=4e-3)


def turbulence(largest: float, slope: float, seed: int) -> torch.Tensor:
    """Isotropic, without divergence: E(k) ~ k^4 below the largest eddies (m) and k^slope beyond (von Karman)."""
    wave = 2 * math.pi * torch.fft.fftfreq(SIZE, STEP, dtype=torch.float64)
    k = torch.stack(torch.meshgrid(wave, wave, wave, indexing="ij")[::-1])
    size = k.square().sum(0).sqrt().clamp_min(1.0)
    x = size * largest / (2 * math.pi)
    energy = x**4 / (1 + x**2) ** ((4 - slope) / 2)
    noise = torch.randn((3, SIZE, SIZE, SIZE), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    modes = torch.fft.fftn(noise, dim=(1, 2, 3)) * (energy.sqrt() / size)
    modes = modes - k * (k * modes).sum(0) / size**2
    modes[:, size > math.pi / STEP] = 0
    return torch.fft.ifftn(modes, dim=(1, 2, 3)).real


@pytest.mark.parametrize(("largest", "slope"), [(25e-3, -5 / 3), (25e-3, -3.0), (15e-3, -3.0), (8e-3, -5.0)])
def test_a_second_pass_takes_at_most_what_the_first_took(largest, slope):
    """And more than a fifth of it where the kernel leaves a third of the energy."""
    resolution, inside = Resolution(box(), None, KERNEL), torch.ones((SIZE,) * 3, dtype=torch.bool)
    true = turbulence(largest, slope, seed=1)
    seen = masked_blur(true, inside, fwhm_to_deviation(KERNEL), (STEP,) * 3)
    again = resolution.of_field(seen, 0)
    whole, once, twice = (float(f.square().sum()) for f in (true, seen, again))
    shown = float(unresolved(once, [once, once], twice))
    assert 1.0 < (whole - once) / shown < 5.0 and once > whole / 3


def test_what_the_walls_drive_keeps_its_detail(filling):
    balance = WallBalance(filling, geometry.WallMotion.from_recording(filling))
    resolution = Resolution(filling, balance, KERNEL)
    known = torch.from_numpy(balance.known(1))
    torch.testing.assert_close(resolution.of_field(known, 1), known, atol=1e-6, rtol=1e-5)
    swirl = torch.randn(known.shape, generator=torch.Generator().manual_seed(0))
    mask = torch.from_numpy(np.array(filling.mask[1], bool))
    rest = resolution.of_field(known + swirl, 1) - known
    expected = masked_blur(swirl, mask, fwhm_to_deviation(KERNEL), tuple(filling.grid.spacing))
    torch.testing.assert_close(rest[:, mask], expected[:, mask], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(torch.from_numpy(resolution.of_rate(swirl.numpy(), 1)), expected)


def test_without_a_kernel_nothing_is_said(filling):
    assert Resolution.of(filling, None, 0.0) is None
    with pytest.raises(ValueError, match="positive width"):
        Resolution(filling, None, 0.0)
    assert isinstance(Resolution.of(filling, None, KERNEL), Resolution)
