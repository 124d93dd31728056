"""Several beats as one: the first whole one, the others as further measurements of it, and how well they repeat."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

import geometry

from .prepared import PreparedMeasurement

__all__ = ["noise_of", "stitched"]

_FRAMES = 4  # whose splines tell how large the noise is


def noise_of(recording: geometry.Recording) -> float:
    """Deviation of a component's error, m/s: as stated, or what splines of a few frames leave."""
    if recording.sigma is not None:
        return float(np.median(np.moveaxis(recording.sigma, 1, 0)[:, np.asarray(recording.mask, bool)]))
    frames = np.unique(np.linspace(0, recording.frames - 1, _FRAMES + 2).astype(int)[1:-1])
    deviation = PreparedMeasurement(recording.select(frames)).error.deviation
    assert deviation is not None  # nothing is stated
    return float(np.sqrt(np.mean(np.median(deviation, axis=0) ** 2)))


def stitched(
    recordings: Sequence[geometry.Recording], period: float | None = None
) -> tuple[list[geometry.Recording], geometry.Repetition | None]:
    """The beats of recordings, the one to be analysed first, and how well they repeat.

    Where they do not, the others are given the larger errors that they then have as measurements of the first, with a
    warning.

    Args:
        recordings: the first one holds at least one whole beat; all begin at the same phase.
        period: s, of a beat; None: that of the first recording.

    Raises:
        ValueError: the period is not known, or there is no whole beat.
    """
    length = recordings[0].period if period is None else period
    beats = [beat for recording in recordings for beat in geometry.split_beats(recording, length)]
    found = None if len(beats) == 1 else geometry.repetition(beats, noise_of(beats[0]))
    if found is not None and not found.repeats:
        warnings.warn(
            f"beats do not repeat: at equal phase they differ by {found.difference:.3g} m/s where the noise is "
            f"{found.noise:.3g} m/s; further beats count as that much less certain",
            stacklevel=2,
        )
        beats = geometry.told_apart(beats, found)
    return beats, found
