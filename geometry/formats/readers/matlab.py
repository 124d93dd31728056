"""MATLAB files: version 5 to 7 by SciPy, version 7.3 (HDF5) by h5py. Arrays have MATLAB's own order of axes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from geometry.formats.source import ArrayLike, FormatError, Source

from .hdf5 import open_hdf5

NUMBERS = ("double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "logical")


class Reversed:
    """A MATLAB array in HDF5, whose axes are stored in the opposite order."""

    def __init__(self, node: ArrayLike) -> None:
        self.node, self.dtype = node, node.dtype
        self.shape = tuple(reversed(node.shape))

    def __getitem__(self, index: tuple) -> np.ndarray:
        if index == (...,):
            return np.asarray(self.node[()]).T
        return np.asarray(self.node[tuple(reversed(index))]).T


class Variable:
    """A variable of a version 5 file, read when it is asked for; the file's last one alone is kept."""

    def __init__(self, load: Callable[[], np.ndarray], shape: tuple[int, ...], kind: str, kept: dict) -> None:
        self._load, self.shape, self._kept = load, shape, kept
        self.dtype = np.dtype({"double": "f8", "single": "f4", "logical": "u1"}.get(kind, kind))

    def __getitem__(self, index: tuple) -> np.ndarray:
        if self not in self._kept:
            self._kept.clear()
            self._kept[self] = self._load()
        return self._kept[self][index]


def open_matlab(path: Path) -> Source:
    """The numeric arrays of a MATLAB file by their names."""
    if h5py.is_hdf5(path):
        source = open_hdf5(path)
        # Everything below '#refs#' belongs to cells and objects.
        arrays = {name: Reversed(node) for name, node in source.arrays.items() if not name.startswith("#")}
        return Source(str(path), arrays, axes=_matlab_axes(arrays), close=source.close)
    from scipy.io import loadmat, whosmat

    try:
        listed = whosmat(str(path))
    except Exception as fault:  # SciPy's reader has errors of many kinds
        raise FormatError(f"{path}: is no readable MATLAB file ({fault})") from fault

    def loader(name: str) -> Callable[[], np.ndarray]:
        return lambda: np.asarray(loadmat(str(path), variable_names=[name])[name])

    kept: dict = {}
    found = {name: Variable(loader(name), shape, kind, kept) for name, shape, kind in listed if kind in NUMBERS}
    return Source(str(path), found, axes=_matlab_axes(found), close=kept.clear)


def _matlab_axes(arrays: dict) -> dict[str, str]:
    """Arrays of `ndgrid` run x, y, z, with times last; components need --axes."""
    names = {2: "xy", 3: "xyz", 4: "xyzt"}
    return {name: names[len(array.shape)] for name, array in arrays.items() if len(array.shape) in names}
