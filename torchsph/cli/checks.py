"""Checks of what was asked for, made before any work begins; each complaint names its option or file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

import geometry
from geometry.recordings.whole_file import refuse_special


def full_vectors(recording: geometry.Recording, path: str | Path) -> geometry.Recording:
    """The recording, refused by its path where it holds less than full vectors."""
    if not geometry.measurement_type(recording).full:
        raise ValueError(
            f"{path}: /beam: holds one component along a beam (Doppler); the methods need full vectors, as "
            "speckle tracking or vector Doppler give them"
        )
    return recording


def usable_device(name: str) -> str:
    """The name of a device, refused where this machine has none of it."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device: unknown device '{name}'; use cpu, cuda or cuda:N") from None
    if device.type not in ("cpu", "cuda"):
        raise ValueError(f"--device: '{name}' is not supported; use cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"--device: this machine has no '{name}' that torch {torch.__version__} can use; use cpu")
    return name


def check_spacing(spacing: float | None, recording: geometry.Recording) -> None:
    """A spacing in millimetres is the likeliest slip: it leaves no room for a particle."""
    vertices = recording.wall_for("--spacing").at(0).vertices
    narrowest = float(np.ptp(vertices, axis=0).min())
    if spacing is not None and spacing > narrowest / 3:
        raise ValueError(
            f"--spacing: {spacing:g} m leaves fewer than 3 particles across the walls ({narrowest:.3g} m); "
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
