"""Smoothing kernels: unit integral, derivative against autodiff, compact support, names."""

import math

import pytest
import torch

from torchsph.pairs.smoothing_kernels import KERNELS, kernel, truncated_gaussian, viscosity_laplacian

SHELL = {2: lambda r: 2 * math.pi * r, 3: lambda r: 4 * math.pi * r**2}


@pytest.mark.parametrize("name", sorted(KERNELS))
@pytest.mark.parametrize("dimension", [2, 3])
def test_integrates_to_one(name, dimension):
    one, h = KERNELS[name], 0.7
    r = torch.linspace(0, one.support * h, 100_001, dtype=torch.float64)
    total = torch.trapezoid(one.value(r, h, dimension) * SHELL[dimension](r), r)
    assert total == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_gradient_factor_is_the_derivative_over_r(name):
    one, h = KERNELS[name], 1.3
    r = torch.linspace(0.01, 0.999 * one.support * h, 400, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(one.value(r, h, 3).sum(), r)
    torch.testing.assert_close(one.gradient_factor(r, h, 3) * r, slope, rtol=1e-10, atol=1e-12)
    assert (slope <= 0).all()


@pytest.mark.parametrize("name", sorted(KERNELS))
def test_nothing_beyond_the_support(name):
    one = KERNELS[name]
    r = torch.tensor([one.support, 1.5 * one.support, 40.0], dtype=torch.float64)
    assert not one.value(r, 1.0, 3).any()
    assert not one.gradient_factor(r, 1.0, 3).any()


@pytest.mark.parametrize(("truncation", "divisor"), [(2.0, 0.73854), (3.0, 0.97071), (4.0, 0.99887)])
def test_truncated_gaussian_has_the_three_dimensional_divisor(truncation, divisor):
    """Errata to 2.11: the one-dimensional divisor of the thesis is wrong in space."""
    at_zero = float(truncated_gaussian(truncation).value(torch.zeros(1, dtype=torch.float64), 1.0, 3))
    assert at_zero == pytest.approx((2 * math.pi) ** -1.5 / divisor, rel=2e-5)


def test_viscosity_laplacian_integrates_like_the_viscosity_kernel():
    """The Laplacian 2.16 of a radial function integrates to the flux of its slope: zero over the whole support."""
    h, r = 1.0, torch.linspace(0, 1.0, 10_001, dtype=torch.float64)
    laplacian = viscosity_laplacian(r, h)
    assert (laplacian >= 0).all()
    # W' = 15/(2 pi h^3) (-3 r^2/(2 h^3) + 2 r/h^2 - h/(2 r^2)): the 1/r^2 part is a point source of strength -15
    smooth = 15 / (2 * math.pi) * (-1.5 * r**2 + 2 * r)
    inside = torch.cumulative_trapezoid(laplacian * 4 * math.pi * r**2, r)
    torch.testing.assert_close(inside, (4 * math.pi * r**2 * smooth)[1:], rtol=1e-3, atol=1e-4)


def test_unknown_names_and_dimensions_are_refused():
    with pytest.raises(ValueError, match="unknown smoothing kernel 'gauss'.*wendland_c2"):
        kernel("gauss")
    with pytest.raises(ValueError, match="no normalisation in 1 dimensions"):
        KERNELS["cubic"].value(torch.zeros(1), 1.0, 1)
    with pytest.raises(ValueError, match="truncation must be positive"):
        truncated_gaussian(0.0)
