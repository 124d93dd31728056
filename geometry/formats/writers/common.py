"""What every export needs: fields in three dimensions, their units, and even times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.formats.source import FormatError
from geometry.recordings.recording import Recording, Wall

UNITS = {"velocity": "m s-1", "sigma": "m s-1", "pressure": "Pa", "pressure_sigma": "Pa"}
UNITS |= {"mask": "1", "weight": "1", "beam": "1", "normal": "1"}
SCALARS = ("mask", "weight", "pressure", "pressure_sigma")
VECTORS = ("velocity", "sigma", "beam", "normal")


def vector(recording: Recording, name: str) -> np.ndarray | None:
    """A vector field as (T, 3, nz, ny, nx); a plane one gets a single layer and no third component."""
    field = getattr(recording, name)
    if field is None:
        return None
    field = np.broadcast_to(field, recording.velocity.shape)
    if recording.dimension == 3:
        return field
    return np.concatenate([field, np.zeros_like(field[:, :1])], axis=1)[:, :, None]


def scalar(recording: Recording, name: str) -> np.ndarray | None:
    """A scalar field as (T, nz, ny, nx), bool as uint8."""
    field = getattr(recording, name)
    if field is None:
        return None
    field = field.astype(np.uint8) if field.dtype == np.bool_ else field
    return field if recording.dimension == 3 else field[:, None]


def lattice(recording: Recording) -> tuple[np.ndarray, np.ndarray, tuple[int, int, int]]:
    """Origin and spacing, m, and counts, each along x, y, z; a plane has one layer at z = 0."""
    grid = recording.grid
    flat = recording.dimension == 2
    origin = np.array([*grid.origin, *([0.0] if flat else [])])
    spacing = np.array([*grid.spacing, *([max(grid.spacing)] if flat else [])])
    nz, ny, nx = (1, *grid.shape) if flat else grid.shape
    return origin, spacing, (nx, ny, nz)


def wall_velocity(wall: Wall, time: np.ndarray) -> np.ndarray:
    """(T, nv, D), m/s: stated, or differenced from the vertices."""
    if wall.velocity is not None:
        return wall.velocity
    shape = (len(time), *wall.vertices.shape[-2:])
    if not wall.moves or len(time) < 2:
        return np.zeros(shape, np.float32)
    return np.gradient(wall.vertices, time, axis=0).astype(np.float32)


def even_interval(recording: Recording, path: Path, instead: str) -> float:
    """Seconds between frames, for formats that hold one interval alone."""
    if recording.frames < 2:
        return 1.0
    steps = np.diff(recording.time)
    if np.abs(steps - steps.mean()).max() > 1e-3 * steps.mean():
        raise FormatError(
            f"{path}: its frames are not evenly spaced in time, and the format has one interval; use {instead}"
        )
    return float(steps.mean())
