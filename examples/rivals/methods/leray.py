"""Helmholtz-Leray projection of a smoothed field: the nearest field without divergence."""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import cg

import geometry

from ..frames import divergence_rows
from . import gaussian


def fit(recording: geometry.Recording, *, fwhm: float = 3e-3, power: float = 1.0) -> np.ndarray:
    """v - D' (D D')^-1 D v with central differences D at nodes whose neighbours lie in the mask."""
    smooth = gaussian.fit(recording, fwhm=fwhm, power=power).astype(np.float64)
    out = np.zeros_like(smooth, np.float32)
    for frame, field in enumerate(smooth):
        mask = np.asarray(recording.mask[frame], bool)
        rows = divergence_rows(mask, recording.grid.spacing)
        inside = field[:, mask].reshape(-1)
        normal = rows @ rows.T
        scale = normal.diagonal().mean()
        pressure, _ = cg(normal / scale, rows @ inside / scale, rtol=1e-6, maxiter=2000)
        out[frame][:, mask] = (inside - rows.T @ pressure).reshape(field.shape[0], -1)
    return out
