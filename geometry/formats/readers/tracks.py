"""Scattered tracks of particles as text, brought onto a grid of choice."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.formats.field_map import FieldMap
from geometry.formats.source import FormatError, Source, diagonal

from .tables import tables

MYPTV = "id,x,y,z,u,v,w,ax,ay,az,t"  # of its `smoothed_trajectories`


def open_tracks(path: Path, said: FieldMap) -> Source:
    """Mean velocities of the points in each cell around a node, and how many points those are.

    Args:
        path: a text file of columns; `said.columns` names them (x, y, z, u, v, w and t, others are passed by),
            else they are those of MyPTV.
        said: needs `grid_spacing`; `bin` frames make one volume (0: all of them).

    Returns:
        `velocity`, `weight` (1 where at least one point lies) and, for cells of two points and more, the
        standard deviation of the mean, `sigma`.
    """
    names = (said.columns or MYPTV).replace(" ", "").split(",")
    rows = np.concatenate(list(tables(path)))
    space = [axis for axis in "xyz" if axis in names]
    needed = [*space, *"uvw"[: len(space)], "t"]
    if len(space) < 2 or any(name not in names for name in needed):
        raise FormatError(f"{path}: columns must name x, y, (z,) u, v, (w) and t, not {','.join(names)}")
    if len(names) != rows.shape[1]:
        raise FormatError(f"{path}: has {rows.shape[1]} columns, but {len(names)} are named: {','.join(names)}")
    if said.grid_spacing is None:
        raise FormatError(f"{path}: on which grid are its points wanted? Say its spacing in m (--grid-spacing 0.005)")
    points, velocity = (rows[:, [names.index(name) for name in group]] for group in (space, "uvw"[: len(space)]))
    unit = said.unit("length")
    if unit is None:
        raise FormatError(f"{path}: in which unit are its lengths? Say it (--length-unit mm)")
    step = said.grid_spacing / unit
    low = np.floor(points.min(axis=0) / step) * step
    counts = np.ceil((points.max(axis=0) - low) / step).astype(int) + 1
    if np.prod(counts.astype(float)) > 1e8:
        raise FormatError(f"{path}: a grid of {' x '.join(map(str, counts))} nodes is too fine for its points")
    frames, volume = _volumes(rows[:, names.index("t")], said.bin)
    shape = (len(frames), *reversed(counts.tolist()))
    cell = np.rint((points - low) / step).astype(int)
    flat = np.ravel_multi_index((volume, *cell.T[::-1]), shape)
    number = np.bincount(flat, minlength=int(np.prod(shape)))
    mean, spread = (np.zeros((len(space), number.size), np.float32) for _ in range(2))
    for axis, values in enumerate(velocity.T):
        total = np.bincount(flat, weights=values, minlength=number.size) / np.maximum(number, 1)
        square = np.bincount(flat, weights=(values - total[flat]) ** 2, minlength=number.size)
        mean[axis], spread[axis] = total, np.sqrt(square / np.maximum(number - 1, 1) / np.maximum(number, 1))
    known = (number > 0).reshape(shape).astype(np.float32)
    arrays = {
        "velocity": mean.reshape(len(space), *shape),
        "sigma": spread.reshape(len(space), *shape),
        "weight": known,
        "mask": np.ones(shape, np.uint8),
    }
    letters = "t" + "zyx"[3 - len(space) :]
    axes = {"velocity": "c" + letters, "sigma": "c" + letters, "weight": letters, "mask": letters}
    return Source(
        str(path),
        arrays,
        axes=axes,
        affine=diagonal([step] * len(space), low),
        length=unit,
        roles={"velocity": ("velocity",), "weight": ("weight",), "mask": ("mask",)},
        time=frames,
    )


def _volumes(time: np.ndarray, every: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean time of each volume, and the volume of each point."""
    frames, frame = np.unique(time, return_inverse=True)
    volume = frame // every if every else np.zeros_like(frame)
    return np.bincount(volume, weights=time) / np.bincount(volume), volume
