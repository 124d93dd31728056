"""Measurements that say nothing, or claim to be exact, refused before any work is done."""

from __future__ import annotations

import numpy as np

import geometry

MEASUREMENT = "the measurement"


def refuse_silent(recording: geometry.Recording, source: str = MEASUREMENT) -> None:
    """Refuse a recording in which nothing was measured.

    Args:
        recording: the measurement.
        source: its file, or what stands for it; it opens the message.

    Raises:
        RecordingError: no node of the mask carries a finite velocity of positive weight, in any frame.
    """
    if carry_values(recording).any():
        return
    if not recording.mask.any():
        rule = "holds no node of blood at any frame, so there is nothing to work on; give 1 inside the blood"
        raise geometry.RecordingError(source, "/mask", rule)
    if recording.weight is None:
        rule = "is not finite at any node of the mask; give the velocities that were measured (m/s)"
        raise geometry.RecordingError(source, "/velocity", rule)
    rule = "is 0 at every node of the mask in all frames, so nothing is known about the flow; give a positive weight"
    raise geometry.RecordingError(source, "/weight", f"{rule} where something was measured, or leave /weight out")


def refuse_exact(recording: geometry.Recording, source: str = MEASUREMENT) -> None:
    """Refuse a recording whose stated error is 0, or no number, where it is to be weighed against a forecast.

    Args:
        recording: the measurement.
        source: its file, or what stands for it; it opens the message.

    Raises:
        RecordingError: a measured node has such a standard deviation.
    """
    if recording.sigma is None:
        return
    fine = (np.isfinite(recording.sigma) & (recording.sigma > 0)).all(axis=1)
    bad = carry_values(recording) & ~fine
    if bad.any():
        frame, *node = (int(number) for number in np.argwhere(bad)[0])
        rule = f"must be positive and finite where something was measured, but is not at {int(bad.sum())} nodes"
        cure = "give the standard deviation in m/s, or leave /sigma out and the errors are estimated"
        raise geometry.RecordingError(
            source, "/sigma", f"{rule}, as at frame {frame}, node {tuple(node)} (array order); {cure}"
        )


def carry_values(recording: geometry.Recording) -> np.ndarray:
    """(T, *shape) bool: nodes that carry a finite value of positive weight."""
    measured = recording.mask & np.isfinite(recording.velocity).all(axis=1)
    return measured if recording.weight is None else measured & (recording.weight > 0)
