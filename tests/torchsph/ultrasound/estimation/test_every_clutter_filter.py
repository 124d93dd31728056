"""What every clutter filter keeps; a new one is under test as soon as `CLUTTER_FILTERS` names it."""

import math

import numpy as np
import pytest
import torch

from torchsph.ultrasound.estimation.clutter import CLUTTER_FILTERS

IMAGES = 16


@pytest.fixture(params=CLUTTER_FILTERS)
def filtering(request):
    return CLUTTER_FILTERS[request.param]()


@pytest.fixture(params=[name for name, make in CLUTTER_FILTERS.items() if not make().adaptive])
def linear(request):
    """A filter that does not depend on the data, and so claims to be linear and to have an exact response."""
    return CLUTTER_FILTERS[request.param]()


def samples(*shape, seed=0, dtype=torch.complex128):
    """Independent complex numbers of power 1."""
    parts = torch.randn((*shape, 2), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.view_as_complex(parts * math.sqrt(0.5)).to(dtype)


def test_what_does_not_move_is_stopped(filtering):
    still = samples(1, 5, 6).expand(IMAGES, 5, 6) * 1e3
    assert filtering.apply(still).abs().max() < 1e-9


@pytest.mark.parametrize("shape", [(), (7,), (4, 5), (2, 3, 4)])
@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_images_keep_their_shape_and_precision(filtering, shape, dtype):
    iq = samples(IMAGES, *shape, dtype=dtype)
    before = iq.clone()
    found = filtering.apply(iq)
    assert found.dtype == dtype and found.shape[1:] == shape and 1 <= len(found) <= IMAGES
    assert torch.equal(iq, before)  # the packet itself is left alone


def test_single_precision_is_double_precision_rounded(filtering):
    iq = samples(IMAGES, 30)
    torch.testing.assert_close(
        filtering.apply(iq.to(torch.complex64)).to(iq), filtering.apply(iq), atol=2e-5, rtol=1e-4
    )


def test_a_complex_factor_passes_through(filtering):
    iq, factor = samples(IMAGES, 12), 3.0 * np.exp(0.7j)
    torch.testing.assert_close(filtering.apply(factor * iq), factor * filtering.apply(iq))


def test_where_a_sample_lies_does_not_matter(filtering):
    iq, order = samples(IMAGES, 20), torch.randperm(20, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(filtering.apply(iq[:, order]), filtering.apply(iq)[:, order])


def test_a_conjugate_view_is_the_conjugate(filtering):
    iq = samples(IMAGES, 12)
    torch.testing.assert_close(filtering.apply(iq.conj()), filtering.apply(iq.conj().resolve_conj()))


def test_a_nan_sample_does_not_spoil_the_others(filtering):
    iq = samples(IMAGES, 6, dtype=torch.complex64)
    iq[3, 2] = math.nan
    assert torch.isfinite(filtering.apply(iq).real[:, [0, 1, 3, 4, 5]]).all()


def test_a_packet_too_short_is_refused(filtering):
    with pytest.raises(ValueError):
        filtering.apply(samples(1, 3))


def test_sums_are_filtered_one_by_one(linear):
    first, second = samples(IMAGES, 9), samples(IMAGES, 9, seed=1)
    found = linear.apply(2j * first - 3 * second)
    torch.testing.assert_close(found, 2j * linear.apply(first) - 3 * linear.apply(second))


@pytest.mark.parametrize("frequency", [0.0, 0.03, 0.11, 0.25, -0.4, 0.5])
def test_the_response_is_the_power_of_a_tone_that_comes_out(linear, frequency):
    tone = torch.exp(2j * math.pi * frequency * torch.arange(IMAGES, dtype=torch.float64))[:, None]
    power = float(linear.apply(tone).abs().square().mean())
    assert power == pytest.approx(float(linear.response(np.array([frequency]))[0]), abs=1e-12)


def test_noise_keeps_the_mean_of_the_response_over_all_frequencies(linear):
    """Parseval: white noise has the same power at every frequency."""
    frequency = np.arange(512) / 512 - 0.5
    assert linear.noise_gain(IMAGES) == pytest.approx(float(linear.response(frequency).mean()), rel=1e-9)


def test_noise_keeps_the_stated_share(filtering):
    kept = float(filtering.apply(samples(IMAGES, 20000, dtype=torch.complex64)).abs().square().mean())
    assert kept == pytest.approx(filtering.noise_gain(IMAGES), rel=0.03)


def test_the_response_lies_between_nothing_and_little_more_than_all(filtering):
    response = filtering.response(np.linspace(-0.5, 0.5, 101))
    assert response.shape == (101,) and response.min() > -1e-12 and response.max() < 1.5
