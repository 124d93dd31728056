"""Images against direct summation over scatterers, and gridding against sums of exponentials."""

import math

import pytest
import torch

from geometry import Grid
from geometry.grids.fields import fwhm_to_deviation
from torchsph.ultrasound.acquisition import Acquisition, Beams, Packet
from torchsph.ultrasound.scanner import gridding
from torchsph.ultrasound.scanner.gridding import Gridding, fast_length
from torchsph.ultrasound.scanner.image import ParallelImager, resize_spectrum
from torchsph.ultrasound.scanner.pointspread import GaussianPointSpread, SampledPointSpread

GRID = Grid((1e-3, -2e-3, 10e-3), (1 / 6e3,) * 3, (24, 22, 20))


PLANE = Grid((1e-3, 10e-3), (1 / 6e3,) * 2, (24, 40))


def scatterers(count=40, dtype=torch.float64, grid=GRID):
    generator = torch.Generator().manual_seed(3)
    span = torch.tensor([5e-3, 6e-3, 6e-3], dtype=dtype)[: grid.dimension]
    unit = torch.rand((count, grid.dimension), generator=generator, dtype=dtype)
    points = torch.tensor(grid.origin, dtype=dtype) - 1e-3 + unit * span
    amplitude = torch.randn((count, 2), generator=generator, dtype=dtype)
    return points, torch.view_as_complex(amplitude)


def direct(points, amplitude, beams, acquisition, pointspread, grid=GRID):
    """sum of a h(x - s) exp(-i 4 pi f depth(s) / c), node by node."""
    nodes = grid.nodes()
    beam = torch.tensor(beams.direction, dtype=torch.float64)
    offset = nodes[:, None] - points.double()
    along = offset @ beam
    across = (offset - along[..., None] * beam).norm(dim=-1)
    axial, lateral = fwhm_to_deviation(pointspread.axial), fwhm_to_deviation(pointspread.lateral)
    envelope = torch.exp(-0.5 * (along / axial) ** 2 - 0.5 * (across / lateral) ** 2)
    phase = torch.exp(-1j * acquisition.phase_per_metre * (points.double() @ beam))
    return ((amplitude.to(torch.complex128) * phase) * envelope).sum(1).view(grid.shape)


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.3, 0.0, 1.0), (1.0, 2.0, 3.0), (0.0, 1.0), (-0.5, 1.0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_image_equals_direct_summation(direction, dtype):
    acquisition, beams, pointspread = Acquisition(), Beams(direction), GaussianPointSpread()
    grid = GRID if len(direction) == 3 else PLANE
    points, amplitude = scatterers(dtype=dtype, grid=grid)
    image = ParallelImager(grid, pointspread, acquisition, beams, dtype=dtype).image(points, amplitude)
    exact = direct(points, amplitude, beams, acquisition, pointspread, grid)
    assert image.dtype == dtype.to_complex()
    assert (image - exact).abs().square().mean().sqrt() < 2e-3 * exact.abs().square().mean().sqrt()


def test_wider_gridding_kernel_comes_closer():
    acquisition, beams, pointspread = Acquisition(), Beams(), GaussianPointSpread()
    points, amplitude = scatterers()
    inside = GRID.contains(points)  # the margin is cut at 1e-3, whatever the gridding
    exact = direct(points[inside], amplitude[inside], beams, acquisition, pointspread)
    error = [
        float(
            (
                ParallelImager(GRID, pointspread, acquisition, beams, width=width, dtype=torch.float64).image(
                    points[inside], amplitude[inside]
                )
                - exact
            )
            .abs()
            .max()
        )
        for width in (3, 5)
    ]
    assert error[1] < 0.3 * error[0]


def test_point_spread_given_as_an_array_equals_the_formula():
    gaussian = GaussianPointSpread()
    step = 1e-4
    axes = [(torch.arange(n, dtype=torch.float64) - n // 2) * step for n in (21, 49, 49)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    axial, lateral = fwhm_to_deviation(gaussian.axial), fwhm_to_deviation(gaussian.lateral)
    values = torch.exp(-0.5 * (z / axial) ** 2 - 0.5 * (x**2 + y**2) / lateral**2).to(torch.complex128)
    sampled = SampledPointSpread(values, (step,) * 3)
    assert sampled.energy(3) == pytest.approx(gaussian.energy(3), rel=1e-3)
    points, amplitude = scatterers(10)
    images = [
        ParallelImager(GRID, spread, Acquisition(), Beams(), dtype=torch.float64).image(points, amplitude)
        for spread in (gaussian, sampled)
    ]
    assert (images[0] - images[1]).abs().max() < 1e-2 * images[0].abs().max()


def test_noise_has_power_one_and_the_colour_of_the_echoes():
    imager = ParallelImager(GRID, GaussianPointSpread(), Acquisition(), Beams())
    generator = torch.Generator().manual_seed(0)
    noise = torch.stack([imager.noise(generator) for _ in range(60)])
    assert float(noise.abs().square().mean()) == pytest.approx(1, abs=0.1)
    lag = 3
    along = (noise[:, lag:].conj() * noise[:, :-lag]).mean().real
    deviation = fwhm_to_deviation(0.5e-3)
    assert float(along) == pytest.approx(math.exp(-((lag / 6e3) ** 2) / (4 * deviation**2)), abs=0.08)


@pytest.mark.parametrize(("width", "oversampling", "tolerance"), [(4, 1.5, 6e-3), (6, 2.0, 2e-5)])
def test_gridding_equals_sums_of_exponentials_in_its_band(width, oversampling, tolerance):
    lattice = Gridding((0.0, 1.0), (0.5, 0.4), (20, 24), width, oversampling)
    generator = torch.Generator().manual_seed(1)
    unit = torch.rand((30, 2), generator=generator, dtype=torch.float64)
    points = unit * torch.tensor([12.0, 8.0]) + torch.tensor([0, 1])
    values = torch.view_as_complex(torch.randn((30, 2), generator=generator, dtype=torch.float64))
    waves = [lattice.wavenumbers(axis, points) for axis in (0, 1)]
    correction = lattice.correction(1, points)[:, None] * lattice.correction(0, points)
    found = torch.fft.fft2(lattice.spread(points, values)) / correction
    phase = waves[1][:, None, None] * (points[:, 1] - 1.0) + waves[0][:, None] * points[:, 0]
    exact = (values * torch.exp(-1j * phase)).sum(-1)
    limit = math.pi / oversampling
    band = (waves[1].abs() * 0.4 <= limit)[:, None] & (waves[0].abs() * 0.5 <= limit)
    error = (found - exact)[band].abs().square().mean().sqrt()
    assert error < tolerance * exact[band].abs().square().mean().sqrt()


def test_gather_is_the_adjoint_of_spread():
    lattice = Gridding((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (9, 10, 11))
    generator = torch.Generator().manual_seed(2)
    points = torch.rand((25, 3), generator=generator, dtype=torch.float64) * 11
    values = torch.randn(25, generator=generator, dtype=torch.float64)
    field = torch.randn((9, 10, 11), generator=generator, dtype=torch.float64)
    assert float((lattice.spread(points, values) * field).sum()) == pytest.approx(
        float(values @ lattice.gather(field, points)), rel=1e-12
    )


@pytest.mark.parametrize(("shape", "width"), [((9, 10, 11), 4), ((9, 10, 11), 5), ((12, 13), 12)])
@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_compiled_gridding_is_that_of_torch(monkeypatch, shape, width, dtype, close):
    axes, generator = len(shape), torch.Generator().manual_seed(1)
    lattice = Gridding((0.5, -1.0, 2.0)[:axes], (0.5, 0.4, 0.3)[:axes], shape, width)
    points = 20 * torch.rand((200, axes), generator=generator, dtype=dtype) - 10  # most lie in repetitions of the box
    points[7, 1] = float("nan")  # counts for nothing
    values = torch.view_as_complex(torch.randn((200, 2), generator=generator, dtype=dtype))
    field, found = lattice.spread(points, values.conj()), lattice.gather(lattice.spread(points, values), points)
    monkeypatch.setattr(gridding, "_compiled", lambda *_: None)
    exact = lattice.spread(points, values)
    torch.testing.assert_close(field.conj().resolve_conj(), exact, atol=close, rtol=close)
    torch.testing.assert_close(found, lattice.gather(exact, points), atol=10 * close, rtol=close)


def test_resized_spectrum_is_the_same_function():
    coarse = torch.arange(15, dtype=torch.float64) / 15
    fine = torch.arange(32, dtype=torch.float64) / 32
    values = torch.cos(2 * math.pi * 3 * coarse) + 1j * torch.sin(2 * math.pi * 5 * coarse)
    series = torch.fft.fft(values, norm="forward")
    expected = torch.cos(2 * math.pi * 3 * fine) + 1j * torch.sin(2 * math.pi * 5 * fine)
    torch.testing.assert_close(torch.fft.ifft(resize_spectrum(series, 0, 32), norm="forward"), expected)


def test_fast_lengths_have_small_factors():
    assert [fast_length(n) for n in (1, 7, 11, 121, 1000)] == [1, 8, 12, 125, 1000]


def test_acquisition_and_packets_refuse_what_makes_no_sense():
    assert Acquisition().aliasing_speed == pytest.approx(0.308)
    with pytest.raises(ValueError, match="prf"):
        Acquisition(prf=0.0)
    with pytest.raises(ValueError, match="direction"):
        Beams((0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="complex"):
        Packet(torch.zeros((2, *GRID.shape)), GRID, Acquisition(), Beams())
    with pytest.raises(ValueError, match="shape"):
        Packet(torch.zeros((2, 3, 3, 3), dtype=torch.complex64), GRID, Acquisition(), Beams())
    with pytest.raises(ValueError, match="apex|SectorImager"):
        ParallelImager(GRID, GaussianPointSpread(), Acquisition(), Beams(apex=(0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="width"):
        GaussianPointSpread(axial=-1.0)
