"""RF to IQ: mixed down to the carrier and low-passed."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from scipy.signal import butter, filtfilt

from .channel_data import ChannelData

ORDER = 5


def demodulated(data: ChannelData) -> ChannelData:
    """The signals as IQ around the acquisition's frequency; IQ is returned as it is.

    RF(t) exp(-2 pi i f t), low-passed forth and back by a Butterworth filter of the pulse's bandwidth (of the carrier
    itself where the bandwidth is not known), as rf2iq of MUST does; the factor 2 keeps the envelope.
    Bandpass-sampled RF, of a rate below twice its frequencies, needs its bandwidth.

    Args:
        data: RF or IQ.

    Raises:
        ValueError: where the rate does not hold the band.
    """
    if data.signals.is_complex():
        return data
    frequency, rate = data.acquisition.frequency, data.sampling_rate
    if data.bandwidth is None and rate < 4 * frequency:
        raise ValueError(
            f"signals: RF of {frequency / 1e6:g} MHz sampled at {rate / 1e6:g} MHz is demodulated only if its "
            "bandwidth is known; give ChannelData(bandwidth=)"
        )
    cutoff = min(2 * frequency / rate, 0.5) if data.bandwidth is None else data.bandwidth * frequency / rate
    if data.bandwidth is not None and _folds(frequency, data.bandwidth * frequency, rate):
        raise ValueError(
            f"signals: a band of {data.bandwidth * frequency / 1e6:g} MHz around {frequency / 1e6:g} MHz folds onto "
            f"itself at {rate / 1e6:g} MHz; sample faster, or give a narrower bandwidth"
        )
    samples = data.signals.shape[1]
    time = data.start + torch.arange(samples, dtype=torch.float64) / rate
    mixer = torch.polar(torch.ones_like(time), -2 * math.pi * frequency * time)
    mixed = (data.signals.double() * mixer[:, None]).numpy()
    iq = 2 * filtfilt(*butter(ORDER, cutoff), mixed, axis=1)
    wide = data.signals.dtype == torch.float64
    return replace(data, signals=torch.from_numpy(iq).to(torch.complex128 if wide else torch.complex64))


def _folds(frequency: float, band: float, rate: float) -> bool:
    """Whether a band and its mirror image overlap after sampling: not in one zone of half the rate."""
    low, high = frequency - band / 2, frequency + band / 2
    return math.floor(2 * low / rate + 1e-9) != math.floor(2 * high / rate - 1e-9)
