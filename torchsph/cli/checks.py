"""Checks of what was asked for, made before any work begins; each complaint names its option or file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import geometry
from geometry.recordings.whole_file import refuse_special
from torchsph.methods.measurement.informative import refuse_exact, refuse_silent
from torchsph.simulator.state.checks import usable_device as known_device


def full_vectors(recording: geometry.Recording, path: str | Path) -> geometry.Recording:
    """The recording, refused by its path where it holds less than full vectors."""
    if not geometry.measurement_type(recording).full:
        raise ValueError(
            f"{path}: /beam: holds one component along a beam (Doppler); the methods need full vectors, as "
            "speckle tracking or vector Doppler give them"
        )
    return recording


def informative(recording: geometry.Recording, path: str | Path) -> geometry.Recording:
    """The recording, refused by its path where nothing was measured or an error is stated as 0."""
    refuse_silent(recording, str(path))
    refuse_exact(recording, str(path))
    return recording


def usable_device(name: str) -> str:
    """The name of a device, refused where this machine has none of it."""
    try:
        return known_device(name)
    except ValueError as fault:
        raise ValueError(f"--device: {fault}") from fault


def check_spacing(spacing: float | None, recording: geometry.Recording, option: str = "--spacing") -> None:
    """A spacing in millimetres is the likeliest slip: it leaves no room for a particle."""
    vertices = recording.wall_for(option).at(0).vertices
    narrowest = float(np.ptp(vertices, axis=0).min())
    if spacing is not None and spacing > narrowest / 3:
        raise ValueError(
            f"{option}: {spacing:g} m leaves fewer than 3 particles across the walls ({narrowest:.3g} m); "
            "it is in metres, 1 mm is 0.001"
        )


def output_file(name: str) -> Path:
    """The path of a file that may be written, refused where it may not."""
    path = Path(name)
    if path.is_dir():
        raise ValueError(f"--out {path}: is a folder; name a file")
    if not path.parent.is_dir():
        raise ValueError(f"--out {path}: the folder {path.parent} does not exist")
    refuse_special(path)
    return path
