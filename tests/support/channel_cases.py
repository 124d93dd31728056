"""What an array receives of point scatterers: echoes summed one by one, by nothing but the way of sound."""

import numpy as np
import torch

from torchsph.ultrasound.acquisition import Acquisition
from torchsph.ultrasound.beamforming.channel_data import ChannelData, linear_array

FREQUENCY, SOUND_SPEED, BANDWIDTH = 5e6, 1540.0, 0.6


def echoes(places, amplitudes, arrival, elements, *, rate, start, samples):
    """RF (samples, elements) of scatterers: a Gaussian pulse around the carrier for each way there and back.

    Args:
        places: (n, D), m.
        amplitudes: (n,).
        arrival: (n,), s, when the wave is at each scatterer.
        elements: (E, D), m.
        rate: Hz.
        start: s, of the first sample.
        samples: of each element.
    """
    width = 0.37 / (BANDWIDTH * FREQUENCY)  # standard deviation, s, of a pulse whose spectrum is 6 dB down at its edges
    reach = int(np.ceil(4 * width * rate))
    offsets = np.arange(-reach, reach + 1)
    rf = np.zeros((len(elements), samples))
    for number, element in enumerate(elements):
        delay = arrival + np.linalg.norm(places - element, axis=1) / SOUND_SPEED
        middle = np.rint((delay - start) * rate).astype(int)
        at = middle[:, None] + offsets
        time = start + at / rate - delay[:, None]
        pulse = amplitudes[:, None] * np.exp(-0.5 * (time / width) ** 2) * np.cos(2 * np.pi * FREQUENCY * time)
        inside = (at >= 0) & (at < samples)
        rf[number] = np.bincount(at[inside], pulse[inside], samples)
    return rf.T


def scanned(frames, amplitudes, delays_of, arrival_of, *, count=64, rate=25e6, start=10e-6, samples=1024, prf=5e3):
    """Channel data of scatterers that stand elsewhere in every image.

    Args:
        frames: places (n, 2), m, in each image.
        amplitudes: (n,).
        delays_of: gives the elements' delays (E,), s, from their places.
        arrival_of: gives when the wave is at places (n, 2), s.
        count: of elements, 0.3 mm apart.
        rate: Hz, of samples.
        start: s, of the first one.
        samples: of each element.
        prf: Hz.
    """
    elements = linear_array(count, 0.3e-3)
    rf = [
        echoes(one, amplitudes, arrival_of(one), elements.numpy(), rate=rate, start=start, samples=samples)
        for one in frames
    ]
    acquisition = Acquisition(FREQUENCY, SOUND_SPEED, prf, len(rf))
    return ChannelData(
        torch.from_numpy(np.stack(rf)), elements, delays_of(elements), rate, acquisition, start, BANDWIDTH
    )


def plane(places):
    """When an unsteered plane wave is at places (n, 2), s; it leaves all elements at 0."""
    return places[:, 1] / SOUND_SPEED


def rotating_disk(rate=60.0, *, images=8, centre=(0.0, 20e-3), radius=5e-3, scatterers=2500, prf=5e3, seed=0):
    """Channel data, by plane waves, of a disk that turns by `rate`, rad/s."""
    generator = np.random.default_rng(seed)
    distance, angle = radius * np.sqrt(generator.random(scatterers)), 2 * np.pi * generator.random(scatterers)
    frames = [
        np.stack([distance * np.cos(angle + turn), distance * np.sin(angle + turn)], 1) + centre
        for turn in rate * np.arange(images) / prf
    ]
    amplitudes = generator.normal(size=scatterers)
    return scanned(frames, amplitudes, lambda elements: torch.zeros(len(elements)).double(), plane, prf=prf)
