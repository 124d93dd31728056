"""A wall that moves by displacements: of a field on a grid over time, or of each vertex.

A displacement tells how far a point of the surface file is from its place there, at each frame: x(t) = X + u(X, t).
Between nodes a field is interpolated linearly along each axis, as ITK does by default, and between its times linearly
in time. A vertex outside of the field, or beside a node without a value, is refused: nothing is extrapolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from geometry.grids.grid import Grid
from geometry.recordings.units import factor

from .field_map import FieldMap
from .registry import open_source
from .series import read_fields
from .source import FormatError, Source

SLACK = 1e-3  # of a spacing, by which a vertex may lie beyond the outermost nodes


@dataclass(frozen=True)
class MotionOptions:
    """The files of displacements and what they do not say.

    Attributes:
        files: one, or one for each frame in order of time; none: the wall does not move by displacements.
        said: the field map of the files, in which `velocity` names the displacements.
        unit: of the displacements, a name or a number of metres; "": what their attribute `units` says, else that of
            the file's lengths, else the wall's.
    """

    files: tuple[str, ...] = ()
    said: FieldMap = FieldMap()
    unit: str = ""


@dataclass(frozen=True, eq=False)
class Displacements:
    """Displacements of points at some times.

    Attributes:
        at: from points (n, 3), m, of the surface file to displacements (T, n, 3), m.
        time: (T,), s, or None where the files do not say.
        count: T.
    """

    at: Callable[[np.ndarray], np.ndarray]
    time: np.ndarray | None
    count: int

    def moved(self, points: np.ndarray, time: np.ndarray | None, period: float, path: Path) -> np.ndarray:
        """Places (T, n, 3), m, of points of the surface file.

        Args:
            points: (n, 3), m.
            time: (T,), s, of the frames wanted; None: at the times of the displacements.
            period: s; the motion repeats after it, 0: it does not.
            path: of the displacements, for messages.

        Raises:
            FormatError: the motion does not cover the times.
        """
        own = points + self.at(points)
        if time is None or (self.time is None and len(time) == self.count):
            return own
        if self.time is None:
            raise FormatError(
                f"{path}: has {self.count} frames of displacements without times, the velocity {len(time)}; say when "
                "they were (time or interval in --motion-map)"
            )
        if len(time) == self.count and np.allclose(time, self.time, rtol=0, atol=1e-6):
            return own
        return _between(own, self.time, time, period, path)


def read_displacements(options: MotionOptions, vertices: np.ndarray, wall_unit: float) -> Displacements:
    """The displacements of files.

    Args:
        options: the files and what they do not say.
        vertices: (n, 3), m, of the surface file, in its own order.
        wall_unit: m per unit of the surface file.

    Raises:
        FileNotFoundError: a file is not there.
        FormatError: a file cannot be understood, or a vertex lies outside of its field.
    """
    paths, said = [Path(name) for name in options.files], options.said
    source = open_source(paths[0], said)
    names = tuple(said.velocity) or tuple(source.roles.get("velocity", ()))
    try:
        unit = _unit(options, source, names, wall_unit)
        timed = source.time is not None or bool(said.time) or said.interval is not None or said.period > 0
        if len(paths) == 1 and len(names) == 1 and _of_vertices(source, names[0], len(vertices)):
            return _by_vertices(source, names[0], vertices, unit, said)
    finally:
        source.close()
    said = replace(said, velocity_unit=repr(unit), interval=said.interval if timed else 1.0)
    fields = read_fields(paths, said, "")
    if fields.grid.dimension != 3:
        raise FormatError(f"{paths[0]}: displacements must have three components on a grid of three axes")
    return Displacements(
        lambda points: _sampled(fields.grid, fields.velocity, fields.turn, points, paths[0]),
        fields.time if timed else None,
        len(fields.time),
    )


def _unit(options: MotionOptions, source: Source, names: Sequence[str], wall_unit: float) -> float:
    """Metres per unit of the displacements: as said, as their attribute `units` says, as of the lengths beside them."""
    if options.unit:
        return factor(options.unit, "length")
    stated = source.attributes.get(names[0], {}).get("units") if names else None
    if stated is None or not str(stated).strip():
        return options.said.unit("length") or source.length or wall_unit
    try:
        return factor(stated.decode() if isinstance(stated, bytes) else str(stated), "length")
    except ValueError as fault:
        raise FormatError(f"{source.path}: {names[0]}: its attribute units: {fault} (--motion-unit)") from fault


def _of_vertices(source: Source, name: str, count: int) -> bool:
    if name not in source.arrays:
        return False
    shape = source.arrays[name].shape
    return len(shape) in (2, 3) and count in shape and 3 in shape


def _by_vertices(source: Source, name: str, vertices: np.ndarray, unit: float, said: FieldMap) -> Displacements:
    """An array with a row of three numbers for each vertex, in any order of axes, and frames along the one left."""
    shape = source.arrays[name].shape
    order = [axis for axis in range(len(shape)) if shape[axis] == len(vertices)]
    components = [axis for axis in range(len(shape)) if shape[axis] == 3 and axis not in order[:1]]
    if len(order) != 1 or len(components) != 1:
        raise FormatError(
            f"{source.path}: {name}: which axes of {shape} are the {len(vertices)} vertices and their three components "
            "cannot be told; store it as (frames, vertices, 3) with other numbers of frames and vertices"
        )
    times = [axis for axis in range(len(shape)) if axis not in (order[0], components[0])]
    values = np.asarray(source.arrays[name][(slice(None),) * len(shape)], np.float64)
    values = unit * np.transpose(values, [*times, order[0], components[0]]).reshape(-1, len(vertices), 3)
    if not np.isfinite(values).all():
        raise FormatError(f"{source.path}: {name}: must be finite for every vertex")
    time: np.ndarray | None = None
    if isinstance(said.time, str) and said.time in source.arrays:
        time = np.asarray(source.arrays[said.time][(...,)], np.float64).reshape(-1) * (said.unit("time") or 1.0)
    elif isinstance(said.time, tuple) and said.time:
        time = np.asarray(said.time) * (said.unit("time") or 1.0)
    elif said.interval is not None:
        time = said.interval * np.arange(len(values))
    if time is not None and len(time) != len(values):
        raise FormatError(f"{source.path}: {len(time)} times for {len(values)} frames of displacements")
    return Displacements(lambda _: values, time, len(values))


def _sampled(grid: Grid, field: np.ndarray, turn: np.ndarray, points: np.ndarray, path: Path) -> np.ndarray:
    """Displacements (T, n, 3), m, of points in the file's coordinates, by a grid and field turned back by `turn`."""
    places = points @ turn
    low, high = np.asarray(grid.origin), np.asarray(grid.upper)
    beyond = np.maximum(low - places, places - high).max(axis=1)
    outside = beyond > SLACK * max(grid.spacing)
    if outside.any():
        raise FormatError(
            f"{path}: {int(outside.sum())} of {len(points)} vertices of the wall lie outside of the field of "
            f"displacements, by up to {1e3 * beyond.max():.3g} mm; give both in the same coordinates and units, or a "
            "field that reaches around the wall"
        )
    stencil = grid.stencil(torch.as_tensor(places))
    found = np.empty((len(field), len(points), 3))
    for frame, values in enumerate(field):
        found[frame] = grid.sample(torch.from_numpy(values.astype(np.float64)), stencil).numpy().T
    unknown = ~np.isfinite(found).all(axis=(0, 2))
    if unknown.any():
        raise FormatError(
            f"{path}: {int(unknown.sum())} of {len(points)} vertices of the wall lie beside nodes without a value; "
            "fill them in the program that made the field"
        )
    return found @ turn.T


def _between(places: np.ndarray, own: np.ndarray, time: np.ndarray, period: float, path: Path) -> np.ndarray:
    """Places at other times, linear between the two next ones; a periodic motion is closed by its first frame."""
    if period > 0:
        time = own[0] + (time - own[0]) % period
        if own[-1] < own[0] + period:
            own, places = np.append(own, own[0] + period), np.concatenate([places, places[:1]])
    slack = 1e-9 + 1e-6 * abs(own[-1] - own[0])
    if time.min() < own[0] - slack or time.max() > own[-1] + slack:
        raise FormatError(
            f"{path}: displacements from {own[0]:g} to {own[-1]:g} s do not cover the frames from {time.min():g} to "
            f"{time.max():g} s; give the period of the beat, or displacements at the times of the frames"
        )
    after = np.clip(np.searchsorted(own, time), 1, len(own) - 1)
    share = np.clip((time - own[after - 1]) / (own[after] - own[after - 1]), 0, 1)[:, None, None]
    return (1 - share) * places[after - 1] + share * places[after]
