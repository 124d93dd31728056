"""Sector images against direct summation, the law by which they widen, their power, and motion tracked in them."""

import math

import pytest
import torch
from ultrasound_cases import cube, lattice

from geometry import Grid
from geometry.grids.fields import fwhm_to_deviation
from torchsph.ultrasound.acquisition import Acquisition, Beams
from torchsph.ultrasound.estimation.doppler import ColourDoppler, colour_doppler
from torchsph.ultrasound.estimation.tracking import SpeckleTracker
from torchsph.ultrasound.measurements.doppler import DopplerOptions
from torchsph.ultrasound.scanner.echoes import EchoModel, simulate_packet
from torchsph.ultrasound.scanner.flow import LinearFlow
from torchsph.ultrasound.scanner.pointspread import GaussianPointSpread, SectorPointSpread
from torchsph.ultrasound.scanner.sector import SectorImager

SHAPE = SectorPointSpread(0.5e-3, 1.2e-3, depth=24e-3)
APEX = {2: (1e-3, 0.0), 3: (1e-3, -2e-3, 0.0)}


def beams(dimension, *tilt):
    return Beams((*(tilt or (0.0,) * (dimension - 1)), 1.0), APEX[dimension])


def direct(nodes, points, amplitude, beams):
    """sum of a h exp(-i 4 pi f range / c), h Gaussian in the range and in the angle between directions."""
    apex = torch.tensor(beams.apex, dtype=torch.float64)
    there, here = points - apex, nodes - apex
    far, near = there.norm(dim=1), here.norm(dim=1)
    middle = torch.tensor(beams.direction, dtype=torch.float64)
    cosines = (here / near[:, None])[:, None] - (there / far[:, None])
    across = cosines - (cosines @ middle)[..., None] * middle
    axial, lateral = fwhm_to_deviation(SHAPE.axial), fwhm_to_deviation(SHAPE.lateral) / SHAPE.depth
    along = (near[:, None] - far) / axial
    envelope = torch.exp(-0.5 * along**2 - 0.5 * (across.norm(dim=-1) / lateral) ** 2)
    phase = torch.exp(-1j * Acquisition().phase_per_metre * far)
    return ((amplitude * phase) * envelope).sum(1)


@pytest.mark.parametrize(("dimension", "tilt"), [(2, ()), (2, (-0.4,)), (3, ()), (3, (0.3, 0.2))])
def test_sector_image_equals_direct_summation(dimension, tilt):
    grid = cube(30, (5e-3, 20e-3)) if dimension == 2 else cube(11, (3e-3, 2e-3, 20e-3))
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand((40, dimension), generator=generator, dtype=torch.float64)
    lower, upper = (torch.tensor(side, dtype=torch.float64) for side in (grid.origin, grid.upper))
    points = lower - 1e-3 + unit * (upper - lower + 2e-3)
    amplitude = torch.view_as_complex(torch.randn((40, 2), generator=generator, dtype=torch.float64))
    imager = SectorImager(grid, SHAPE, Acquisition(), beams(dimension, *tilt), dtype=torch.float64)
    exact = direct(grid.nodes(), points, amplitude, beams(dimension, *tilt)).view(grid.shape)
    error = imager.image(points, amplitude) - exact
    assert error.abs().square().mean().sqrt() < 4e-3 * exact.abs().square().mean().sqrt()


@pytest.mark.parametrize("depth", [12e-3, 24e-3, 48e-3])
def test_a_point_is_as_wide_across_as_it_is_deep_and_always_as_long(depth):
    """Half maximum lies half a width away, along and across a beam 20 degrees off the middle."""
    beam = torch.tensor([math.sin(math.radians(20)), math.cos(math.radians(20))], dtype=torch.float64)
    point = torch.tensor(APEX[2], dtype=torch.float64) + depth * beam
    # an aperture seen at an angle is narrower by the cosine, and its beam wider
    across, wide = beam.flip(0) * torch.tensor([1.0, -1.0]), 0.05 * depth / float(beam[1])
    for direction, width in ((beam, 0.5e-3), (across, wide)):
        for side in (-0.5, 0.5):
            inner, outer = (float(lone_echo(point, point + share * side * width * direction)) for share in (0.95, 1.05))
            assert outer < 0.5 < inner and inner - outer < 0.1


def lone_echo(point, node):
    """|IQ| at ``node`` of one scatterer at ``point``."""
    grid = Grid(tuple(node.tolist()), (1e-4, 1e-4), (2, 2))
    imager = SectorImager(grid, SHAPE, Acquisition(), beams(2), dtype=torch.float64, width=6)
    return imager.image(point[None], torch.ones(1, dtype=torch.complex128))[0, 0].abs()


def test_blood_is_as_bright_near_as_far():
    grid = Grid((-6e-3, 10e-3), (0.3e-3, 0.3e-3), (130, 41))
    model = EchoModel(pointspread=SHAPE, beams=beams(2), acquisition=Acquisition(packet=1), tissue=None, snr=None)
    power = torch.zeros(grid.shape)
    for seed in range(12):
        packet = simulate_packet(LinearFlow((0.0, 0.0)), grid, model, 0.0, torch.Generator().manual_seed(seed))
        power += packet.iq[0].abs().square() / 12
    near, far = power[:40].mean(), power[-40:].mean()
    assert float(near) == pytest.approx(1, abs=0.12) and float(far) == pytest.approx(1, abs=0.15)


def test_motion_is_tracked_in_a_sector_and_doppler_sees_its_beams():
    centre, velocity = (6e-3, 22e-3), (0.25, 0.2)
    model = EchoModel(pointspread=SHAPE, beams=beams(2), tissue=None)
    points, errors, speeds = lattice(centre, 3), [], []
    for seed in range(2):
        packet = simulate_packet(
            LinearFlow(velocity), cube(30, centre), model, 0.0, torch.Generator().manual_seed(seed)
        )
        found = SpeckleTracker(clutter=None).track(packet, points)
        assert found.accepted.float().mean() > 0.9
        errors.append((found.velocity - torch.tensor(velocity))[found.accepted])
        speeds.append(colour_doppler(packet, points, ColourDoppler(clutter=None)).speed)
    error = torch.cat(errors)
    assert (error.mean(0).abs() < 0.02).all() and error[:, 0].std() < 0.06 and error[:, 1].std() < 0.02
    along = model.beams.directions(points).float() @ torch.tensor(velocity)
    assert (torch.stack(speeds).mean(0) - along).abs().median() < 0.01
    assert float(along.max() - along.min()) > 0.02  # the beams do fan out here


def test_sectors_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="behind the apex"):
        SectorImager(cube(4, (0.0, 0.0)), SHAPE, Acquisition(), beams(2))
    with pytest.raises(ValueError, match="ParallelImager"):
        SectorImager(cube(4), SHAPE, Acquisition(), Beams())
    with pytest.raises(ValueError, match="SectorPointSpread"):
        EchoModel(pointspread=GaussianPointSpread(), beams=beams(3))
    with pytest.raises(ValueError, match="depth"):
        SectorPointSpread(depth=0.0)
    with pytest.raises(ValueError, match="not both"):
        DopplerOptions(apex=(0.0, 0.0, -0.03), steering=20.0)
