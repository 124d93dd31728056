"""Clutter filters against their stated responses and against NumPy."""

import math

import numpy as np
import pytest
import torch
from scipy.signal import convolve, firwin, freqz

from torchsph.ultrasound.estimation.clutter import FIRFilter, PolynomialFilter, SVDFilter

FREQUENCY = np.linspace(0, 0.5, 26)


def tone(frequency, images=16):
    return torch.exp(2j * math.pi * frequency * torch.arange(images, dtype=torch.float64))[:, None]


def test_the_usual_design_leaks_and_ours_has_a_null_at_zero_frequency():
    usual = firwin(9, 0.12, pass_zero=False)
    assert 20 * math.log10(abs(usual.sum()) / np.abs(freqz(usual)[1]).max()) > -7  # the trap: -5.9 dB
    assert FIRFilter().response(np.zeros(1))[0] < 1e-24
    assert FIRFilter().apply(torch.full((16, 5), 1e3 + 1e3j, dtype=torch.complex128)).abs().max() < 1e-9
    # flat to second order: a tenth of the frequency passes 1e-4 of the power or less of what it did
    low = FIRFilter().response(np.array([0.001, 0.01]))
    assert low[1] / low[0] == pytest.approx(1e4, rel=0.05)


def test_fir_response_is_that_of_its_coefficients_and_of_tones():
    filtering = FIRFilter(11, 0.2)
    _, exact = freqz(filtering.coefficients(), worN=2 * np.pi * FREQUENCY)
    np.testing.assert_allclose(filtering.response(FREQUENCY), np.abs(exact) ** 2, atol=1e-12)
    for frequency in (0.03, 0.11, 0.4):
        power = filtering.apply(tone(frequency)).abs().square()
        np.testing.assert_allclose(power.numpy(), filtering.response(np.array([frequency]))[0], rtol=1e-9)
    assert filtering.response(np.array([0.5]))[0] == pytest.approx(1)


@pytest.mark.parametrize("images", [9, 24, 61])
def test_fir_filter_is_scipys_convolution(images):
    packet = np.random.default_rng(0).standard_normal((2, images, 3, 4))
    packet = packet[0] + 1j * packet[1]
    exact = convolve(packet, FIRFilter().coefficients()[:, None, None], mode="valid")
    np.testing.assert_allclose(FIRFilter().apply(torch.from_numpy(packet)).numpy(), exact, atol=1e-13)


def test_polynomial_filter_removes_polynomials_and_has_its_response():
    filtering, time = PolynomialFilter(3), torch.linspace(-1, 1, 16, dtype=torch.float64)
    history = (2 - time + 3j * time**3)[:, None].to(torch.complex128)
    assert filtering.apply(history).abs().max() < 1e-12
    for frequency in (0.05, 0.2):
        power = filtering.apply(tone(frequency)).abs().square().mean()
        assert float(power) == pytest.approx(filtering.response(np.array([frequency]))[0], rel=1e-9)


def test_svd_filter_removes_what_numpy_calls_the_strongest_components():
    generator = torch.Generator().manual_seed(0)
    parts = torch.randn((10, 40, 2), generator=generator, dtype=torch.float64)
    iq = torch.view_as_complex(parts) * torch.linspace(1, 4, 10)[:, None]
    left, values, right = np.linalg.svd(iq.numpy(), full_matrices=False)
    values[:2] = 0
    np.testing.assert_allclose(SVDFilter(2).apply(iq).numpy(), (left * values) @ right, atol=1e-10)


@pytest.mark.parametrize("filtering", [FIRFilter(), PolynomialFilter(2), SVDFilter(1)])
def test_tissue_of_sixty_decibel_goes_and_fast_blood_stays(filtering):
    still = 1e3 * torch.ones((16, 50), dtype=torch.complex128)
    blood = tone(0.3) * torch.exp(1j * torch.arange(50, dtype=torch.float64))
    left = filtering.apply(still + blood)
    assert float(left.abs().square().mean()) == pytest.approx(1, abs=0.5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FIRFilter(8), "odd"),
        (lambda: FIRFilter(9, 1.0), "cutoff"),
        (lambda: PolynomialFilter(-1), "order"),
        (lambda: SVDFilter(0), "rank"),
        (lambda: FIRFilter(9).apply(torch.zeros((8, 1)) + 0j), "9 taps"),
        (lambda: PolynomialFilter(3).apply(torch.zeros((4, 1)) + 0j), "leaves nothing"),
        (lambda: SVDFilter(3).apply(torch.zeros((3, 1)) + 0j), "leaves nothing"),
    ],
)
def test_what_a_filter_cannot_do_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
