"""Measurements as a scanner with a limit shows them: speeds beyond it come back on the other side."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from geometry import Recording, measurement_type
from geometry.arguments import checked


@checked
def aliased(measured: Recording, limit: float) -> Recording:
    """A measurement whose components have wrapped into the interval from -limit to limit.

    Args:
        measured: velocities along a beam (colour Doppler), or vectors of which each component wraps (phase contrast).
        limit: m/s, the Nyquist velocity of Doppler, the VENC of phase contrast.

    Returns:
        The measurement with ``nyquist``.

    Raises:
        ValueError: a limit that is not positive.
    """
    if not (math.isfinite(limit) and limit > 0):
        raise ValueError(f"aliased: limit must be positive and finite (m/s), got {limit!r}")
    kind, velocity = measurement_type(measured), measured.velocity.copy()
    for frame, field in enumerate(velocity):
        for direction in np.broadcast_to(kind.directions(frame), (kind.parts, *field.shape)):
            speed = (np.nan_to_num(field) * direction).sum(0, dtype=np.float64)
            field -= (2 * limit * np.rint(speed / (2 * limit)) * direction).astype(np.float32)
    return replace(measured, velocity=velocity, nyquist=np.full(measured.frames, limit))
