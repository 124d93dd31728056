"""The fields of one file, of arrays spread over several, or of a file for each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from .assemble import Fields, assemble
from .axis_order import in_best_order
from .field_map import FieldMap
from .registry import open_source
from .source import FormatError, Source, understood


def read_fields(paths: Sequence[Path], said: FieldMap, format: str) -> Fields:
    """The fields of all files; of a file for each frame one is open at a time.

    Args:
        paths: of one series.
        said: what the files do not say.
        format: name of the format, "" where the names' ends tell.

    Raises:
        FormatError: a file cannot be understood, or the files do not belong together.
    """
    with understood(paths[0]):
        return _read(paths, said, format)


def _read(paths: Sequence[Path], said: FieldMap, format: str) -> Fields:
    first = open_source(paths[0], said, format)
    wanted = [name for name in (*said.velocity, said.mask, said.weight, *said.sigma) if name]
    if len(paths) == 1 or all(name in first.arrays for name in wanted):
        return _in_a_row(first, paths, said, format)
    sources = [first, *(open_source(path, said, format) for path in paths[1:])]
    try:
        together = _merged(sources, said)
        return _assembled(together, said)[0]
    finally:
        for source in sources:
            source.close()


def _assembled(source: Source, said: FieldMap) -> tuple[Fields, str]:
    """The fields, and the order of axes: with `axes="auto"` that of least divergence."""
    return in_best_order(source, said) if said.axes == "auto" else (assemble(source, said), said.axes)


def _merged(sources: Sequence[Source], said: FieldMap) -> Source:
    """All arrays of several files as of one: the field map names arrays that lie in different ones."""
    arrays = {name: (source, array) for source in sources for name, array in source.arrays.items()}
    wanted = [name for name in (*said.velocity, said.mask, said.weight, *said.sigma) if name]
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise FormatError(f"{sources[0].path}: neither it nor those beside it have {', '.join(missing)}")
    if sum(len(source.arrays) for source in sources) != len(arrays):
        raise FormatError(f"{sources[0].path}: it and those beside it have arrays of one name; name files of one kind")
    first = next(source for source in sources if wanted[0] in source.arrays)
    for source in sources:
        if (
            first.affine is not None
            and source.affine is not None
            and not (
                source.affine.shape == first.affine.shape
                and np.allclose(source.affine, first.affine, rtol=1e-4, atol=1e-4)
            )
        ):
            raise FormatError(f"{source.path}: lies elsewhere than {first.path}; resample it to the same grid")

    def gathered(of: str) -> dict:
        merged: dict = {}
        for source in sources:
            merged |= dict(getattr(source, of))
        return merged

    return replace(
        first,
        arrays={name: array for name, (_, array) in arrays.items()},
        attributes=gathered("attributes"),
        axes=gathered("axes"),
        roles=gathered("roles"),
    )


def _in_a_row(first: Source, paths: Sequence[Path], said: FieldMap, format: str) -> Fields:
    """The frames of a file, or of several in a row, each brought to its place before the next is opened."""
    part, axes = _part(first, said, alone=len(paths) == 1)
    if len(paths) == 1:
        return part
    said, frames = replace(said, axes=axes), len(part.time)
    whole, names = {}, ("velocity", "mask", "weight", "sigma")
    for name in names:
        values = getattr(part, name)
        if values is not None:
            whole[name] = np.empty((frames * len(paths), *values.shape[1:]), values.dtype)
    grid, time = part.grid, np.empty(frames * len(paths))
    for number, path in enumerate(paths):
        if number > 0:
            part, _ = _part(open_source(path, said, format), said, alone=False)
        if part.grid.shape != grid.shape or not np.allclose(part.grid.origin, grid.origin, atol=1e-9):
            raise FormatError(f"{path}: has another grid than {paths[0]}; the frames of a series share theirs")
        if len(part.time) != frames or {name for name in names if getattr(part, name) is not None} != set(whole):
            raise FormatError(f"{path}: holds other frames or fields than {paths[0]}; files of a series are alike")
        rows = slice(number * frames, (number + 1) * frames)
        time[rows] = part.time
        for name, values in whole.items():
            values[rows] = getattr(part, name)
    mask, weight, sigma = (whole.get(name) for name in ("mask", "weight", "sigma"))
    time = _times(time, said, paths[0])
    return replace(part, time=time, velocity=whole["velocity"], mask=mask, weight=weight, sigma=sigma)


def _part(source: Source, said: FieldMap, *, alone: bool) -> tuple[Fields, str]:
    """The fields of a file, which is closed; where it has no times, those of a series come later."""
    try:
        later = not alone and source.time is None and not (isinstance(said.time, str) and said.time)
        return _assembled(source, replace(said, interval=1.0, time="") if later else said)
    finally:
        source.close()


def _times(time: np.ndarray, said: FieldMap, first: Path) -> np.ndarray:
    """What is said of the times of a series, else what its files say."""
    if isinstance(said.time, tuple) and said.time:
        return np.asarray(said.time) * (said.unit("time") or 1.0)
    if said.interval is not None:
        return said.interval * np.arange(len(time))
    if (np.diff(time) > 0).all():
        return time
    if not said.period:
        raise FormatError(f"{first}: when were the {len(time)} frames? Say it (--interval S or --period S)")
    return said.period * np.arange(len(time)) / len(time)
