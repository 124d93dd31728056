"""Constrained least squares on the grid, as intraventricular vector flow mapping has it (after Vixege et al. 2021).

Data, mass conservation, free slip at the walls and smoothness, each weighted; the normal equations by conjugate
gradients. All rows are scaled to velocities by the grid's spacing.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import block_diag, diags
from scipy.sparse.linalg import cg

import geometry

from ..frames import confidence, divergence_rows, laplacian_rows, wall_rows


def fit(
    recording: geometry.Recording,
    *,
    smoothness: float = 1.0,
    divergence: float = 10.0,
    wall: float = 3.0,
    power: float = 1.0,
) -> np.ndarray:
    """Frame by frame, starting from the one before."""
    out = np.zeros(recording.velocity.shape, np.float32)
    weights = confidence(recording) ** power
    motion = geometry.WallMotion.from_recording(recording)
    step = float(min(recording.grid.spacing))
    for frame in range(recording.frames):
        mask = np.asarray(recording.mask[frame], bool)
        trust = np.tile(weights[frame][mask], recording.dimension)
        data = np.nan_to_num(recording.velocity[frame])[:, mask].reshape(-1)
        mass = step * divergence_rows(mask, recording.grid.spacing)
        curvature = laplacian_rows(mask)
        smooth = block_diag([curvature.T @ curvature] * recording.dimension, format="csr")
        rows, asked = wall_rows(recording, motion, frame)
        normal = (
            diags(trust)
            + divergence**2 * (mass.T @ mass)
            + smoothness**2 * smooth
            + wall**2 * (rows.T @ rows)
            + 1e-6 * diags(np.ones(len(data)))
        )
        right = trust * data + wall**2 * (rows.T @ asked)
        start = out[frame - 1][:, mask].reshape(-1).astype(np.float64) if frame else None
        found, _ = cg(normal, right, x0=start, rtol=1e-4, maxiter=1500, M=diags(1 / normal.diagonal()))
        out[frame][:, mask] = found.reshape(recording.dimension, -1)
    return out
