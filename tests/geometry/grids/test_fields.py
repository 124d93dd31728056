"""Grid averages, coloured noise and masked derivatives against SciPy and closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from geometry.grids.fields import (
    fwhm_to_deviation,
    gaussian_kernel,
    masked_blur,
    masked_gradient,
    smooth_noise,
)

SPACING = (1e-3, 2e-3, 1.5e-3)  # x, y, z: unequal, so that a swapped axis shows


def test_full_width_at_half_maximum():
    deviation = fwhm_to_deviation(3.0)
    assert math.exp(-0.5 * (1.5 / deviation) ** 2) == pytest.approx(0.5)


def test_masked_blur_equals_scipy_in_a_full_box():
    field = torch.randn((2, 9, 10, 11), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    mask = torch.ones(field.shape[1:], dtype=torch.bool)
    deviation = 2e-3
    ours = masked_blur(field, mask, deviation, SPACING)
    widths = [deviation / step for step in SPACING[::-1]]

    def blur(values):
        # same reach as ours: SciPy rounds truncate * sigma, so give the radius itself
        return gaussian_filter(values, widths, mode="constant", radius=[math.ceil(3.5 * w) for w in widths])

    expected = np.stack([blur(part.numpy()) for part in field]) / blur(np.ones(field.shape[1:]))
    np.testing.assert_allclose(ours.numpy(), expected, atol=1e-12)


def test_masked_blur_keeps_a_constant_and_ignores_what_is_outside():
    mask = torch.rand((8, 9, 10), generator=torch.Generator().manual_seed(2)) < 0.5
    field = torch.where(mask, 3.0, 1e6)[None]
    blurred = masked_blur(field, mask, 2e-3, SPACING)[0]
    torch.testing.assert_close(blurred[mask], torch.full((int(mask.sum()),), 3.0), rtol=1e-5, atol=0)
    assert not blurred[~mask].any()


def test_smooth_noise_has_unit_variance_to_the_edge_and_the_stated_autocorrelation():
    deviation, spacing = 2e-3, (1e-3, 1e-3, 2e-3)
    noise = smooth_noise(300, (8, 16, 16), deviation, spacing, torch.Generator().manual_seed(3))
    assert noise.square().mean().item() == pytest.approx(1, abs=0.03)
    assert noise[:, 0, 0, 0].square().mean().item() == pytest.approx(1, abs=0.25)  # a corner, 300 draws
    for lag, axis, step in ((2, -1, 1e-3), (4, -2, 1e-3), (2, -3, 2e-3)):
        size = noise.shape[axis]
        product = noise.narrow(axis, 0, size - lag) * noise.narrow(axis, lag, size - lag)
        assert product.mean().item() == pytest.approx(math.exp(-((lag * step) ** 2) / (4 * deviation**2)), abs=0.03)


def test_gradient_is_exact_for_linear_fields_wherever_a_neighbour_is_inside():
    generator = torch.Generator().manual_seed(4)
    slope = torch.randn((3, 3), generator=generator, dtype=torch.float64)
    axes = [torch.arange(n, dtype=torch.float64) * step for n, step in zip((6, 7, 8), SPACING[::-1], strict=True)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    field = torch.einsum("cd,dzyx->czyx", slope, torch.stack([x, y, z]))
    mask = torch.zeros((6, 7, 8), dtype=torch.bool)
    mask[1:5, 2:4, 3:] = True
    gradient = masked_gradient(torch.where(mask, field, torch.nan), mask, SPACING)
    expected = slope.view(3, 3, 1).expand(3, 3, int(mask.sum()))
    torch.testing.assert_close(gradient[..., mask], expected)


def test_gradient_is_zero_at_a_lonely_node():
    mask = torch.zeros((3, 3), dtype=torch.bool)
    mask[1, 1] = True
    assert not masked_gradient(torch.ones((2, 3, 3)), mask, (1e-3, 1e-3)).any()


def test_a_kernel_without_width_is_refused():
    with pytest.raises(ValueError, match="deviation and step"):
        gaussian_kernel(0.0, 1e-3)
