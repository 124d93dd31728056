"""What every point-spread function keeps; the last test fails until a new one stands in `EXAMPLES`."""

import importlib
import inspect
import math
import pkgutil

import pytest
import torch

from geometry.grids.fields import fwhm_to_deviation
from torchsph import ultrasound
from torchsph.ultrasound.scanner.pointspread import (
    GaussianPointSpread,
    PointSpread,
    SampledPointSpread,
    SectorPointSpread,
)


def sampled(dimension):
    """A Gaussian as an array, wider across than along the last axis."""
    spacing = (2e-4,) * (dimension - 1) + (1e-4,)
    widths = (0.9e-3,) * (dimension - 1) + (0.4e-3,)
    axes = [
        (torch.arange(n, dtype=torch.float64) - n // 2) * step / fwhm_to_deviation(width)
        for n, step, width in zip((19,) * (dimension - 1) + (17,), spacing, widths, strict=True)
    ]
    place = torch.meshgrid(*reversed(axes), indexing="ij")
    return SampledPointSpread(2.5j * torch.exp(-0.5 * sum(axis.square() for axis in place)), spacing)


EXAMPLES = {
    "gaussian": lambda dimension: GaussianPointSpread(0.5e-3, 1.2e-3),
    "short gaussian": lambda dimension: GaussianPointSpread(0.2e-3, 0.3e-3),
    "sector": lambda dimension: SectorPointSpread(0.5e-3, 1.2e-3, 50e-3).in_beam_coordinates(),
    "sampled": sampled,
}
DIRECTIONS = ((0.0, 1.0), (0.6, 0.8), (0.0, 0.0, 1.0), (2 / 3, -1 / 3, 2 / 3))
CASES = [
    pytest.param((name, direction), id=f"{name}, {len(direction)}-D, {'straight' if direction[-1] == 1 else 'oblique'}")
    for name in EXAMPLES
    for direction in DIRECTIONS
    if name != "sector" or direction[-1] == 1  # whose own coordinates have the beam along the last axis
]


@pytest.fixture(params=CASES)
def case(request):
    return request.param


@pytest.fixture
def direction(case):
    return case[1]


@pytest.fixture
def spread(case):
    return EXAMPLES[case[0]](len(case[1]))


def lattice(spread, direction):
    """Steps, m, at which the band just fits, and nodes that hold twice the reach on either side; x first."""
    steps = [math.pi / band for band in spread.band(direction)]
    nodes = [2 * math.ceil(2 * reach / step) for reach, step in zip(spread.reach(direction), steps, strict=True)]
    return steps, nodes


def wavenumbers(steps, nodes, dtype=torch.float64):
    """Angular wavenumbers of each axis, rad/m, as views that broadcast to an array (..., y, x)."""
    waves = []
    for axis, (step, count) in enumerate(zip(steps, nodes, strict=True)):
        view = [1] * len(steps)
        view[-1 - axis] = -1
        waves.append((2 * math.pi * torch.fft.fftfreq(count, step, dtype=torch.float64)).to(dtype).view(view))
    return waves


def transform(spread, direction):
    """The transform on its lattice, and that lattice."""
    steps, nodes = lattice(spread, direction)
    found = spread.transform(wavenumbers(steps, nodes), direction)
    assert found.shape == tuple(reversed(nodes))
    return found.to(torch.complex128), steps, nodes


def test_the_peak_is_one_and_at_the_origin(spread, direction):
    """1 % is what the band may leave out (see `BAND`)."""
    found, steps, _ = transform(spread, direction)
    picture = torch.fft.ifftn(found) / math.prod(steps)
    assert int(picture.abs().argmax()) == 0
    assert float(picture.flatten()[0].abs()) == pytest.approx(1, abs=0.01)


def test_it_is_the_same_on_both_sides_of_the_origin(spread, direction):
    found, _, _ = transform(spread, direction)
    mirrored = found.flip(tuple(range(found.dim()))).roll((1,) * found.dim(), tuple(range(found.dim())))
    inner = torch.ones(found.shape, dtype=torch.bool)
    for axis, n in enumerate(found.shape):
        inner.narrow(axis, n // 2, 1).fill_(False)  # the Nyquist wavenumber has no partner
    assert float((found - mirrored).abs()[inner].max()) < 1e-9 * float(found.abs().max())


def test_a_beam_from_the_other_side_sees_the_same(spread, direction):
    steps, nodes = lattice(spread, direction)
    waves = wavenumbers(steps, nodes)
    torch.testing.assert_close(
        spread.transform(waves, direction), spread.transform(waves, tuple(-part for part in direction))
    )


def test_its_energy_is_that_of_its_transform(spread, direction):
    """Parseval: the integral of |h|^2 is that of |H|^2 over (2 pi)^D."""
    found, steps, nodes = transform(spread, direction)
    cell = math.prod(2 * math.pi / (step * count) for step, count in zip(steps, nodes, strict=True))
    energy = float(found.abs().square().sum()) * cell / (2 * math.pi) ** len(direction)
    assert spread.energy(len(direction)) == pytest.approx(energy, rel=2e-3)


def test_nothing_is_left_beyond_its_reach(spread, direction):
    found, steps, nodes = transform(spread, direction)
    power = torch.fft.ifftn(found).abs().square()
    for axis, (step, count, reach) in enumerate(zip(steps, nodes, spread.reach(direction), strict=True)):
        place = torch.fft.fftfreq(count, 1 / (count * step), dtype=torch.float64)
        beyond = power.movedim(-1 - axis, 0)[place.abs() > reach]
        assert float(beyond.sum()) < 1e-4 * float(power.sum())


def test_nothing_is_left_beyond_its_band(spread, direction):
    """At the band's rim, where the other wavenumbers are zero, 2 % of the highest is left at the most."""
    highest = float(spread.transform([torch.zeros(1, dtype=torch.float64)] * len(direction), direction).abs())
    for axis, band in enumerate(spread.band(direction)):
        waves = [torch.zeros(1, dtype=torch.float64)] * len(direction)
        waves[axis] = torch.tensor([-band, band], dtype=torch.float64)
        assert float(spread.transform(waves, direction).abs().max()) < 0.02 * highest


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_is_that_of_the_wavenumbers(spread, direction, dtype):
    steps, nodes = lattice(spread, direction)
    found = spread.transform(wavenumbers(steps, nodes, dtype), direction)
    exact = spread.transform(wavenumbers(steps, nodes), direction)
    assert found.abs().dtype == dtype
    assert float((found - exact).abs().max()) < (2e-5 if dtype == torch.float32 else 1e-15) * float(exact.abs().max())


def test_every_point_spread_stands_among_the_examples():
    needed = [name for name in vars(PointSpread) if not name.startswith("_")]
    assert sorted(needed) == ["band", "energy", "reach", "transform"]
    found = set()
    for module in pkgutil.walk_packages(ultrasound.__path__, f"{ultrasound.__name__}."):
        for _, kind in inspect.getmembers(importlib.import_module(module.name), inspect.isclass):
            if kind is not PointSpread and all(callable(getattr(kind, name, None)) for name in needed):
                found.add(kind)
    assert found == {type(example(dimension)) for example in EXAMPLES.values() for dimension in (2, 3)}
