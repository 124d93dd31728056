"""The amplitude that members share: seen by the flow that the walls drive, and left out of that flow."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import geometry
from torchsph.methods.measurement.wall_balance import WallBalance, amplitude_error
from torchsph.methods.members.amplitude import Amplitude


@pytest.fixture(scope="module")
def filling() -> geometry.Recording:
    return geometry.Ventricle().recording([0.28, 0.30, 0.32], grid_spacing=2e-3, wall_spacing=2e-3)


@pytest.fixture(scope="module")
def balance(filling) -> WallBalance:
    return WallBalance(filling, geometry.WallMotion.from_recording(filling))


def estimate(filling, balance, factor, added=0.0):
    known = np.stack([balance.known(frame) for frame in range(filling.frames)])
    return filling.with_velocity(np.float32(factor) * known + np.float32(added))


def test_the_known_flow_passes_what_the_walls_displace():
    """A layer's mean velocity times its area is -dV/dt of the blood below: of an affine motion, by hand."""
    ventricle, time, step = geometry.Ventricle(), 0.30, 1e-4
    recording = ventricle.recording([0.29, time, 0.31])
    known = WallBalance(recording, geometry.WallMotion.from_recording(recording)).known(1)
    heights = recording.grid.nodes().numpy().reshape(*recording.grid.shape, 3)[:, 0, 0, 2]

    def below(height: float, t: float) -> float:
        across, _, along = ventricle.scales(t)
        z = np.linspace(-ventricle.length, height / along, 4001)
        square = ventricle.semi_minor**2 * (1 - ((z + ventricle.offset) / ventricle.semi_major) ** 2)
        return float(np.trapezoid(np.pi * across**2 * along * np.maximum(square, 0), z))

    for layer in np.flatnonzero((heights < -5e-3) & (heights > -22e-3)):
        area = (below(heights[layer] + 1e-6, time) - below(heights[layer] - 1e-6, time)) / 2e-6
        mean = known[2, layer][np.asarray(recording.mask[1, layer], bool)].mean()
        lost = (below(heights[layer], time + step) - below(heights[layer], time - step)) / (2 * step)
        assert mean * area == pytest.approx(-lost, rel=0.03)


def test_an_amplitude_is_found_by_the_flow_that_is_known(filling, balance):
    assert amplitude_error(balance, estimate(filling, balance, 1.0)) == pytest.approx(0, abs=1e-6)
    assert amplitude_error(balance, estimate(filling, balance, 0.8)) == pytest.approx(0.2, abs=1e-6)
    assert amplitude_error(balance, estimate(filling, balance, 1.1)) == pytest.approx(0.1, abs=1e-6)


def test_members_differ_by_a_factor_on_all_but_the_known_flow(filling, balance):
    amplitude = Amplitude(balance, 0.1, 8, seed=3)
    assert float(amplitude.off.mean()) == pytest.approx(0, abs=1e-7)
    assert float(amplitude.off.std()) == pytest.approx(0.1, rel=1e-6)
    assert torch.equal(amplitude.off, Amplitude(balance, 0.1, 8, seed=3).off)
    known = torch.from_numpy(balance.known(1))
    assert float(amplitude.of_fields(known, 1).abs().max()) < 1e-6
    swirl = torch.randn(known.shape, generator=torch.Generator().manual_seed(0))
    added = amplitude.of_fields(known + swirl, 1)
    torch.testing.assert_close(added, amplitude.off.reshape(8, 1, 1, 1, 1) * swirl, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(amplitude.of_rates(swirl), amplitude.off.reshape(8, 1, 1, 1, 1) * swirl)


def test_without_walls_members_have_the_estimates_amplitude():
    nothing = Amplitude(None, 0.1, 4)
    assert float(nothing.of_fields(torch.ones(3, 2, 2, 2), 0)) == 0
    assert float(nothing.of_rates(torch.ones(3, 2, 2, 2))) == 0
