"""Normalised correlation by its definition, and its peaks between the nodes."""

import numpy as np
import pytest
import torch

from torchsph.native.library import LibraryMissing, library
from torchsph.ultrasound.estimation import backends
from torchsph.ultrasound.estimation.correlation import KernelShape
from torchsph.ultrasound.estimation.peak import find_peak
from torchsph.ultrasound.scanner.gridding import Gridding

try:
    library()
    COMPILED = ["cpu"]
except LibraryMissing:
    COMPILED = []
BACKENDS = ["reference", *COMPILED]


def random_volume(seed=0, dtype=torch.float64, images=5):
    generator = torch.Generator().manual_seed(seed)
    return torch.view_as_complex(torch.randn((20, 18, 16, images, 2), generator=generator, dtype=dtype))


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
@pytest.mark.parametrize("images", [3, 5, 19], ids="of {}".format)
def test_correlation_equals_its_definition_at_every_lag(name, dtype, close, images):
    volume, shape = random_volume(dtype=dtype, images=images), KernelShape((2, 1, 1), (1, 2, 1))
    corner, offset = torch.tensor([[4, 5, 5], [8, 6, 7], [14, 13, 12]]), torch.tensor([[0, 0, 0], [1, -1, 2], [0] * 3])
    ramp = torch.tensor([[0.3, 0.0, -0.2], [0.0, 0.1, 0.0], [0.0, 0.0, 0.0]], dtype=dtype)
    rho = backends.choose_backend(name).correlate(volume, 2, corner, offset, shape, ramp=ramp).numpy()
    samples = volume.numpy().astype(np.complex128)
    for point in range(3):
        z, y, x = corner[point].tolist()
        place = [np.arange(-h, h + 1) for h in shape.half]
        turn = sum(g * n for g, n in zip(ramp[point].tolist(), np.meshgrid(*place, indexing="ij"), strict=True))
        kernel = samples[z : z + 5, y : y + 3, x : x + 3, :-2] * np.exp(2j * turn)[..., None]
        for lag in np.ndindex(*shape.lags):
            a, b, c = (
                n + o + k - s for n, o, k, s in zip((z, y, x), offset[point].tolist(), lag, shape.search, strict=True)
            )
            other = samples[a : a + 5, b : b + 3, c : c + 3, 2:]
            exact = (kernel.conj() * other).sum() / (np.linalg.norm(kernel) * np.linalg.norm(other))
            assert abs(rho[(point, *lag)] - exact) < close


@pytest.mark.parametrize("name", BACKENDS)
def test_a_silent_kernel_correlates_with_nothing(name):
    volume = torch.zeros((20, 18, 16, 3), dtype=torch.complex64)
    shape, still = KernelShape((1,) * 3, (1,) * 3), torch.zeros((1, 3), dtype=torch.long)
    assert not backends.choose_backend(name).correlate(volume, 1, torch.tensor([[5, 5, 5]]), still, shape).abs().any()


@pytest.mark.skipif(not COMPILED, reason="no C++ compiler: there are no compiled sums to compare with torch's")
@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_compiled_sums_over_images_and_boxes_are_those_of_torch(dtype, close):
    images = random_volume(1, dtype, 6).movedim(-1, 0).conj()  # a view, its conjugate still to be taken
    margin, half = (3, 2, 4), (2, 1, 3)
    middle = torch.tensor([[3, 2, 4], [22, 19, 19], [12, 9, 12]])
    found = []
    for backend in map(backends.choose_backend, BACKENDS):
        volume, power, turn = backend.arrange(images, margin, turns=True)
        found.append(
            [
                volume,
                power,
                turn,
                backend.mean_power(images),
                backend.box_sums(power, middle, half),
                *(backend.sums_around(turn, widths)(middle) for widths in (half, (0, 9, 5))),
            ]
        )
    for compiled, reference in zip(found[1], found[0], strict=True):
        torch.testing.assert_close(compiled, reference, atol=close, rtol=close)


@pytest.mark.skipif(not COMPILED, reason="no C++ compiler: torch decides how its sums are split")
def test_the_number_of_threads_changes_nothing():
    sums, volume = backends.choose_backend("cpu"), random_volume(dtype=torch.float32)
    generator = torch.Generator().manual_seed(2)
    corner, shape = torch.randint(4, 9, (40, 3), generator=generator), KernelShape((1,) * 3, (2,) * 3)
    lattice, points = Gridding((0.0,) * 3, (1.0,) * 3, (9, 10, 11)), 12 * torch.rand((300, 3), generator=generator)
    found, threads = [], torch.get_num_threads()
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            spread = lattice.spread(points, torch.polar(points[:, 0], points[:, 1]))
            found.append([sums.correlate(volume, 1, corner, torch.zeros_like(corner), shape), spread])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, three) for one, three in zip(*found, strict=True))


def test_what_was_asked_for_by_name_and_is_missing_is_an_error(monkeypatch):
    def missing():
        raise LibraryMissing("no compiler here")

    monkeypatch.setattr(backends, "library", missing)
    assert backends.choose_backend().name == "reference"
    for arguments, message in ((("cpu",), "no compiler here"), (("cpu", "cuda"), "on 'cuda'"), (("gpu",), "unknown")):
        with pytest.raises(ValueError, match=message):
            backends.choose_backend(*arguments)


@pytest.mark.skipif(not COMPILED, reason="no C++ compiler: torch itself refuses nodes outside a volume")
def test_kernels_outside_the_volume_are_refused():
    volume, shape, still = random_volume(), KernelShape((1,) * 3, (1,) * 3), torch.zeros((1, 3), dtype=torch.long)
    for corner in ([0, 5, 5], [5, 5, 13]):
        with pytest.raises(IndexError, match="volume of"):
            backends.choose_backend("cpu").correlate(volume, 1, torch.tensor([corner]), still, shape)


def gaussian_peak(curve, vertex, lags):
    """0.9 exp(-quadratic) with second derivatives -curve of its logarithm, times a phase."""
    axis = torch.arange(-(lags // 2), lags // 2 + 1, dtype=torch.float64)
    offset = torch.stack(torch.meshgrid(*[axis] * len(vertex), indexing="ij"), -1) - torch.tensor(vertex).double()
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
