"""Normalised correlation by its definition, and its peaks between the nodes."""

import numpy as np
import pytest
import torch

from torchsph.ultrasound.correlation import KernelShape, correlate, image_pairs
from torchsph.ultrasound.peak import find_peak


def random_volume(seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.view_as_complex(torch.randn((20, 18, 16, 5, 2), generator=generator, dtype=dtype))


def test_correlation_equals_its_definition_at_every_lag():
    volume, shape = random_volume(), KernelShape((2, 1, 1), (1, 2, 1))
    corner, offset = torch.tensor([[4, 5, 5], [8, 6, 7]]), torch.tensor([[0, 0, 0], [1, -1, 2]])
    ramp = torch.tensor([[0.3, 0.0, -0.2], [0.0, 0.1, 0.0]], dtype=torch.float64)
    rho = correlate(image_pairs(volume, 2, shape.half), corner, offset, shape, ramp=ramp)
    for point in range(2):
        z, y, x = corner[point].tolist()
        place = [torch.arange(-h, h + 1, dtype=torch.float64) for h in shape.half]
        turn = sum(g * n for g, n in zip(ramp[point], torch.meshgrid(*place, indexing="ij"), strict=True))
        kernel = volume[z : z + 5, y : y + 3, x : x + 3, :-2] * torch.exp(2j * turn)[..., None]
        for lag in np.ndindex(*shape.lags):
            a, b, c = (
                n + o + k - s
                for n, o, k, s in zip((z, y, x), offset[point].tolist(), lag, shape.search, strict=True)
            )
            other = volume[a : a + 5, b : b + 3, c : c + 3, 2:]
            exact = (kernel.conj() * other).sum() / (kernel.norm() * other.norm())
            assert abs(complex(rho[(point, *lag)]) - complex(exact)) < 1e-12


def test_a_silent_kernel_correlates_with_nothing():
    volume = torch.zeros((20, 18, 16, 3), dtype=torch.complex64)
    shape = KernelShape((1,) * 3, (1,) * 3)
    pairs = image_pairs(volume, 1, shape.half)
    rho = correlate(pairs, torch.tensor([[5, 5, 5]]), torch.zeros((1, 3), dtype=torch.long), shape)
    assert not rho.abs().any()


def gaussian_peak(curve, vertex, lags):
    """0.9 exp(-quadratic) with second derivatives -curve of its logarithm, times a phase."""
    axis = torch.arange(-(lags // 2), lags // 2 + 1, dtype=torch.float64)
    offset = (
        torch.stack(torch.meshgrid(*[axis] * len(vertex), indexing="ij"), -1) - torch.tensor(vertex).double()
    )
    height = 0.9 * torch.exp(-0.5 * torch.einsum("...a,ab,...b->...", offset, curve, offset))
    return (height * np.exp(0.7j))[None]


CURVE = torch.tensor([[0.04, 0.01, 0.0], [0.01, 0.03, 0.01], [0.0, 0.01, 0.05]], dtype=torch.float64)


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("vertex", [(0.3, -0.4, 0.2), (-1.3, 0.9, 0.1), (2.3, 0.0, 0.0)])
def test_peak_of_a_gaussian_is_exact_also_beyond_the_rim(axes, vertex):
    curve = CURVE[:axes, :axes]
    peak = find_peak(gaussian_peak(curve, vertex[:axes], 5))
    np.testing.assert_allclose(peak.lag[0].numpy(), vertex[:axes], atol=1e-9)
    np.testing.assert_allclose(peak.hessian[0].numpy(), -curve.numpy(), atol=1e-9)
    assert complex(peak.value[0]) == pytest.approx(0.9 * np.exp(0.7j), abs=0.01)  # from a parabola of its own
    assert bool(peak.concave)


def test_a_peak_on_a_given_plane_is_the_highest_there():
    curve = torch.tensor([[0.10, 0.04], [0.04, 0.08]], dtype=torch.float64)
    peak = find_peak(gaussian_peak(curve, (0.1, 0.2), 3))
    direction = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    found = peak.constrained(direction, torch.tensor([0.4], dtype=torch.float64))
    # with the first lag 0.3 off the vertex the second follows by -curve01 / curve11 times that
    np.testing.assert_allclose(found[0].numpy(), [0.4, 0.2 - 0.5 * 0.3], atol=1e-9)


def test_two_separate_peaks_are_told_by_their_ratio():
    rho = torch.full((1, 7, 7), 0.1, dtype=torch.complex128)
    rho[0, 2, 2], rho[0, 5, 5] = 0.8, 0.4
    assert float(find_peak(rho).ratio) == pytest.approx(2)
