"""A Gaussian over time on top of another rival, over the frames in which a node lies in the mask."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import geometry


def fit(recording: geometry.Recording, *, on: Callable[..., np.ndarray], width: float = 0.01, **settings) -> np.ndarray:
    """What ``on`` makes of the recording with ``settings``, averaged with standard deviation ``width`` (s)."""
    field = np.asarray(on(recording, **settings), np.float64)
    mask = np.asarray(recording.mask, bool)
    apart = recording.time[:, None] - recording.time[None]
    kernel = np.exp(-0.5 * (apart / width) ** 2)
    total = np.einsum("st,t...->s...", kernel, mask.astype(np.float64))
    summed = np.einsum("st,tk...->sk...", kernel, field * mask[:, None])
    return np.where(mask[:, None], summed / np.maximum(total, 1e-12)[:, None], 0.0).astype(np.float32)
