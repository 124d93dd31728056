"""Our images beside those of PyMUST, which computes the pressure field of every element of an array.

The numbers in pymust_plane.npz were made by examples/benchmarks/ultrasound/tracking_pymust.py.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from geometry import Grid
from torchsph.ultrasound.acquisition import Acquisition, Beams
from torchsph.ultrasound.scanner.echoes import EchoModel, simulate_packet
from torchsph.ultrasound.scanner.flow import LinearFlow
from torchsph.ultrasound.scanner.image import ParallelImager
from torchsph.ultrasound.scanner.pointspread import GaussianPointSpread, SampledPointSpread

BEAMS = Beams((0.0, 1.0))


@pytest.fixture(scope="module")
def peer():
    with np.load(Path(__file__).parent / "pymust_plane.npz") as found:
        return dict(found)


def plane(peer):
    step, shape = tuple(peer["step"].tolist()), peer["point"].shape
    origin = (-(shape[1] // 2) * step[0], float(peer["depth"]) - (shape[0] // 2) * step[1])
    return Grid(origin, step, shape)


def acquisition(peer, packet=16):
    return Acquisition(float(peer["frequency"]), float(peer["sound_speed"]), packet=packet)


def half_width(curve, step):
    """Full width at half maximum of a curve that falls from its first value on, mirrored."""
    below = int(np.argmax(curve < 0.5 * curve[0]))
    share = (curve[below - 1] - 0.5 * curve[0]) / (curve[below - 1] - curve[below])
    return 2 * step * (below - 1 + share)


def image(peer, pointspread, x, z, amplitude):
    imager = ParallelImager(plane(peer), pointspread, acquisition(peer), BEAMS, dtype=torch.float64, width=6)
    points = torch.from_numpy(np.stack([np.atleast_1d(x), np.atleast_1d(z)], 1)).double()
    return imager.image(points, torch.from_numpy(np.atleast_1d(amplitude)).to(torch.complex128)).numpy()


def likeness(ours, theirs):
    """|normalised inner product|: 1 for images equal up to a factor."""
    return abs(np.vdot(ours, theirs)) / np.linalg.norm(ours) / np.linalg.norm(theirs)


def test_scatterers_imaged_with_their_point_response_give_their_image(peer):
    """Phase and magnitude of 400 overlapping echoes; what is left is how PyMUST's response varies in space."""
    given = SampledPointSpread(torch.from_numpy(peer["point"]), tuple(peer["step"].tolist()))
    ours = image(peer, given, peer["x"], peer["z"], peer["amplitude"])
    assert likeness(ours, peer["image"]) > 0.99
    mirrored = image(peer, given, -peer["x"], peer["z"], peer["amplitude"])
    assert likeness(mirrored, peer["image"]) < 0.5  # the measure does tell images apart


def test_a_gaussian_of_their_widths_is_close_to_their_point_response(peer):
    magnitude, step = np.abs(peer["point"]), peer["step"]
    row, column = (n // 2 for n in magnitude.shape)
    axial, lateral = half_width(magnitude[row:, column], step[1]), half_width(magnitude[row, column:], step[0])
    ours = np.abs(image(peer, GaussianPointSpread(axial, lateral), 0.0, float(peer["depth"]), 1.0))
    assert likeness(ours, magnitude) > 0.9
    np.testing.assert_allclose(half_width(ours[row:, column], step[1]), axial, rtol=0.02)
    np.testing.assert_allclose(half_width(ours[row, column:], step[0]), lateral, rtol=0.02)


def test_speckle_has_their_contrast_and_their_grain(peer):
    """Contrast 1.91 (Rayleigh), and the autocorrelation of the point response: both theirs and ours."""
    given = SampledPointSpread(torch.from_numpy(peer["point"]), tuple(peer["step"].tolist()))
    model = EchoModel(acquisition(peer, 1), given, BEAMS, snr=None, tissue=None, density=10.0)
    images = []
    for seed in range(30):
        generator = torch.Generator().manual_seed(seed)
        images.append(simulate_packet(LinearFlow((0.0, 0.0)), plane(peer), model, 0.0, generator).iq[0].numpy())
    ours = np.stack(images)
    contrast = np.abs(ours).mean() / np.abs(ours).std()
    assert contrast == pytest.approx(float(peer["contrast"]), abs=0.07)
    assert contrast == pytest.approx(1.913, abs=0.07)
    for axis, name, step in ((1, "axial_width", peer["step"][1]), (2, "lateral_width", peer["step"][0])):
        lines = np.moveaxis(ours, axis, -1)
        curve = [abs((lines[..., lag:] * lines[..., : lines.shape[-1] - lag].conj()).mean()) for lag in range(20)]
        assert half_width(np.array(curve), step) == pytest.approx(float(peer[name]), rel=0.06), name
