"""NumPy archives (.npz)."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from geometry.formats.source import FormatError, Source


class Member:
    """An array of an archive: its header now, its values when they are asked for.

    Rows of leading numbers that follow one another, as (frame, component, ...), are unpacked as they come; anything
    else unpacks the whole array.
    """

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._archive, self._name = archive, name
        with archive.open(name) as file:
            version = npy.read_magic(file)
            header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            self.shape, self._reversed, self.dtype = header(file)
            self._start = file.tell()
        self._stream: IO[bytes] | None = None

    def _whole(self) -> np.ndarray:
        with self._archive.open(self._name) as file:
            return npy.read_array(file, allow_pickle=False)

    def __getitem__(self, index: tuple) -> np.ndarray:
        whole = slice(None)
        lead = next((place for place, one in enumerate(index) if one is ... or one == whole), len(index))
        rest = self.shape[lead:]
        if self._reversed or len(index) != len(self.shape) or any(one != whole for one in index[lead:]):
            return self._whole()[index]
        count = int(np.prod(rest))
        number = int(np.ravel_multi_index(index[:lead], self.shape[:lead])) if lead else 0
        if self._stream is None:
            self._stream = self._archive.open(self._name)
        self._stream.seek(self._start + number * count * self.dtype.itemsize)
        values = np.empty(rest, self.dtype)
        if self._stream.readinto(values.reshape(-1).view(np.uint8)) != values.nbytes:  # type: ignore[attr-defined]
            raise FormatError(f"{self._archive.filename}: {self._name}: ends before its {self.shape} values do")
        return values


def open_npz(path: Path) -> Source:
    """The numeric arrays of an archive by their names; none that would need pickle."""
    try:
        archive = zipfile.ZipFile(path)
        members = {name.removesuffix(".npy"): Member(archive, name) for name in archive.namelist()}
    except (zipfile.BadZipFile, ValueError) as fault:
        raise FormatError(f"{path}: is no readable NumPy archive ({fault})") from fault
    arrays = {name: member for name, member in members.items() if member.dtype.kind in "fiub"}
    return Source(str(path), arrays, close=archive.close)
