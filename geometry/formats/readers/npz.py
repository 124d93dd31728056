"""NumPy archives (.npz)."""

from __future__ import annotations

import zipfile
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

from geometry.formats.source import FormatError, Source


class Member:
    """An array of an archive: its header now, its values when they are first asked for."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._archive, self._name = archive, name
        with archive.open(name) as file:
            version = npy.read_magic(file)
            header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            self.shape, _, self.dtype = header(file)

    @cached_property
    def _values(self) -> np.ndarray:
        with self._archive.open(self._name) as file:
            return npy.read_array(file, allow_pickle=False)

    def __getitem__(self, index: tuple) -> np.ndarray:
        return self._values[index]


def open_npz(path: Path) -> Source:
    """The numeric arrays of an archive by their names; none that would need pickle."""
    try:
        archive = zipfile.ZipFile(path)
        members = {name.removesuffix(".npy"): Member(archive, name) for name in archive.namelist()}
    except (zipfile.BadZipFile, ValueError) as fault:
        raise FormatError(f"{path}: is no readable NumPy archive ({fault})") from fault
    arrays = {name: member for name, member in members.items() if member.dtype.kind in "fiub"}
    return Source(str(path), arrays, close=archive.close)
