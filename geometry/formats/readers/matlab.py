"""MATLAB files: version 5 to 7 listed by SciPy, version 7.3 (HDF5) by h5py. Arrays have MATLAB's own order of axes."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from geometry.formats.source import ArrayLike, FormatError, Source

from .hdf5 import open_hdf5
from .matlab_elements import element
from .streamed import Streamed

NUMBERS = ("double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "logical")


class Reversed:
    """A MATLAB array in HDF5, whose axes are stored in the opposite order."""

    order = "F"

    def __init__(self, node: ArrayLike) -> None:
        self.node, self.dtype = node, node.dtype
        self.shape = tuple(reversed(node.shape))
        chunks = getattr(node, "chunks", None)
        self.chunks = tuple(reversed(chunks)) if chunks else None

    def __getitem__(self, index: tuple) -> np.ndarray:
        if index == (...,):
            return np.asarray(self.node[()]).T
        return np.asarray(self.node[tuple(reversed(index))]).T


class Variable:
    """A variable of a version 5 to 7 file, looked for when it is asked for."""

    order = "F"

    def __init__(self, path: Path, name: str, shape: tuple[int, ...], kind: str) -> None:
        self._path, self._name, self.shape = path, name, shape
        self.dtype = np.dtype({"double": "f8", "single": "f4", "logical": "u1"}.get(kind, kind))

    @cached_property
    def _stream(self) -> Streamed:
        return element(self._path, self._name, self.shape)

    def __getitem__(self, index: tuple) -> np.ndarray:
        return self._stream[index]

    def close(self) -> None:
        """Close the file, if it was opened."""
        if "_stream" in self.__dict__:
            self._stream.close()


def open_matlab(path: Path) -> Source:
    """The numeric arrays of a MATLAB file by their names."""
    if h5py.is_hdf5(path):
        source = open_hdf5(path)
        # Everything below '#refs#' belongs to cells and objects.
        arrays = {name: Reversed(node) for name, node in source.arrays.items() if not name.startswith("#")}
        return Source(str(path), arrays, axes=_matlab_axes(arrays), close=source.close)
    from scipy.io import whosmat

    try:
        listed = whosmat(str(path))
    except Exception as fault:  # SciPy's reader has errors of many kinds
        raise FormatError(f"{path}: is no readable MATLAB file ({fault})") from fault
    found = {name: Variable(path, name, shape, kind) for name, shape, kind in listed if kind in NUMBERS}

    def close() -> None:
        for one in found.values():
            one.close()

    return Source(str(path), found, axes=_matlab_axes(found), close=close)


def _matlab_axes(arrays: dict) -> dict[str, str]:
    """Arrays of `ndgrid` run x, y, z, with times last; components need --axes."""
    names = {2: "xy", 3: "xyz", 4: "xyzt"}
    return {name: names[len(array.shape)] for name, array in arrays.items() if len(array.shape) in names}
