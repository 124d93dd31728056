"""Weighted Gaussian smoothing: what every lab has."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

import geometry

from ..frames import confidence


def fit(recording: geometry.Recording, *, fwhm: float = 4e-3, power: float = 1.0) -> np.ndarray:
    """Means over Gaussians of full width at half maximum ``fwhm`` (m), weighted by confidence ** ``power``."""
    weight = confidence(recording) ** power
    deviation = [0.0, *(fwhm / 2.3548 / np.array(recording.grid.spacing[::-1]))]
    total = gaussian_filter(weight, deviation, mode="constant")
    field = np.nan_to_num(recording.velocity) * (weight[:, None] > 0)
    summed = np.stack(
        [gaussian_filter(field[:, k] * weight, deviation, mode="constant") for k in range(recording.dimension)], 1
    )
    mask = np.asarray(recording.mask, bool)[:, None]
    return np.where(mask & (total[:, None] > 1e-9), summed / np.maximum(total[:, None], 1e-9), 0.0).astype(np.float32)
