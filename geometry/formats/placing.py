"""The values of a file's array, brought to their places in a recording, a block of neighbours at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product

import numpy as np

from .orientation import Orientation
from .source import ArrayLike

PARTS = 32  # blocks of an array at least, so that one of them and its copies weigh little beside the result
MOST = 1 << 20  # values of a block
LEAST = 1 << 12

Index = tuple[slice, ...]


def blocks(array: ArrayLike) -> Iterator[Index]:
    """Slices that read an array once, in the order in which it is stored.

    Args:
        array: with `order` "F" where its first axis runs fastest, with `chunks` where it is stored in such pieces,
            which are then not cut.
    """
    shape = array.shape
    chunks = getattr(array, "chunks", None)
    pieces = tuple(chunks) if isinstance(chunks, tuple) and len(chunks) == len(shape) else (1,) * len(shape)
    slow_first = list(range(len(shape)))
    if getattr(array, "order", "C") == "F":
        slow_first.reverse()
    size = math.prod(shape)
    wanted, extent = min(max(size // PARTS, LEAST), MOST), list(shape)
    for axis in slow_first:
        whole = math.prod(extent)
        if whole <= wanted:
            break
        layers = max(1, wanted // (whole // extent[axis]))
        extent[axis] = min(shape[axis], -(-layers // pieces[axis]) * pieces[axis])
    starts = [range(0, shape[axis], max(extent[axis], 1)) for axis in slow_first]
    for corner in product(*starts):
        first = dict(zip(slow_first, corner, strict=True))
        yield tuple(slice(first[axis], min(first[axis] + extent[axis], shape[axis])) for axis in range(len(shape)))


def placed(array: ArrayLike, letters: str, lie: Orientation) -> Iterator[tuple[Index, np.ndarray]]:
    """The blocks of an array as (frames, components, *grid), and the slices of those axes that each fills.

    Args:
        array: of a file.
        letters: what its axes mean, of `t`, `c`, `x`, `y`, `z`.
        lie: how the image lies.
    """
    dimension = len(lie.order)
    full = "tc" + "zyx"[3 - dimension :]
    for index in blocks(array):
        at = dict(zip(letters, index, strict=True))
        values = np.transpose(np.asarray(array[index]), [letters.index(letter) for letter in full if letter in letters])
        for place, letter in enumerate("tc"):
            if letter not in letters:
                values = np.expand_dims(values, place)
        where = [at.get("t", slice(0, 1)), at.get("c", slice(0, 1))]
        for axis in reversed(range(dimension)):
            letter = "xyz"[lie.order[axis]]
            part, count = at[letter], array.shape[letters.index(letter)]
            where.append(part if lie.sense[axis] > 0 else slice(count - part.stop, count - part.start))
        yield tuple(where), lie.field(values)


def fill_vectors(
    result: np.ndarray,
    arrays: Sequence[tuple[ArrayLike, str, Mapping[str, object], float]],
    lie: Orientation,
    matrix: np.ndarray,
) -> None:
    """Add a vector field to `result`, (T, D, *grid).

    Args:
        result: zeros.
        arrays: one with all components, or one of each: values, meaning of the axes, attributes, factor to SI units.
        lie: how the image lies.
        matrix: (D, D), recorded components from the stored ones.
    """
    for number, (array, letters, about, unit) in enumerate(arrays):
        for where, values in placed(array, letters, lie):
            with np.errstate(invalid="ignore", over="ignore"):  # told by the checks of the recording
                plain = unpacked(values, about) * unit
            first = where[1].start if len(arrays) == 1 else number
            for component in range(first, min(first + values.shape[1], result.shape[1])):
                for axis in np.flatnonzero(matrix[:, component]).tolist():
                    turned = matrix[axis, component] * plain[:, component - first]
                    with np.errstate(over="ignore"):
                        narrow = np.asarray(turned, np.float32)
                    result[where[0], axis][(slice(None), *where[2:])] += narrow


def fill_scalar(
    result: np.ndarray,
    array: ArrayLike,
    letters: str,
    about: Mapping[str, object],
    lie: Orientation,
    meaning: Callable[[np.ndarray], np.ndarray],
) -> None:
    """Write what the values of a scalar field mean into `result`, (T, *grid); a single frame stands for all."""
    for where, values in placed(array, letters, lie):
        result[(where[0], *where[2:])] = meaning(unpacked(values, about)[:, 0])
    if "t" not in letters or array.shape[letters.index("t")] == 1:
        result[1:] = result[0]


def unpacked(values: np.ndarray, about: Mapping[str, object]) -> np.ndarray:
    """Values with `scale_factor` and `add_offset` applied, NaN where the file has its fill value."""
    number = {
        key: float(np.asarray(about[key]).reshape(-1)[0])
        for key in ("scale_factor", "add_offset", "_FillValue")
        if key in about
    }
    plain = values.astype(np.float32) if values.dtype != np.float64 else values
    if "scale_factor" in number or "add_offset" in number:
        plain = values * number.get("scale_factor", 1.0) + number.get("add_offset", 0.0)
    return np.where(values == number["_FillValue"], np.nan, plain) if "_FillValue" in number else plain
