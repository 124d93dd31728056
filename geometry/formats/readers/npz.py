"""NumPy archives (.npz)."""

from __future__ import annotations

import zipfile
from pathlib import Path

from numpy.lib import format as npy

from geometry.formats.source import FormatError, Source

from .streamed import Streamed


def open_npz(path: Path) -> Source:
    """The numeric arrays of an archive by their names; none that would need pickle."""
    try:
        archive = zipfile.ZipFile(path)
        members = {entry.filename.removesuffix(".npy"): _member(path, archive, entry) for entry in archive.infolist()}
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as fault:
        raise fault if isinstance(fault, FormatError) else _unreadable(path, fault) from fault
    arrays = {name: member for name, member in members.items() if member is not None}
    return Source(str(path), arrays, close=archive.close)


def _unreadable(path: Path, fault: Exception) -> FormatError:
    return FormatError(f"{path}: is no readable NumPy archive ({fault})")


def _member(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Streamed | None:
    """An array of an archive, None where it holds no numbers: its header now, its values when they are asked for."""
    with archive.open(entry) as file:
        version = npy.read_magic(file)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, reversed_axes, dtype = header(file)
        start = file.tell()
    if dtype.kind not in "fiub":
        return None
    packed = entry.compress_type != zipfile.ZIP_STORED
    return Streamed(
        path,
        lambda: archive.open(entry),
        start,
        shape,
        dtype,
        order="F" if reversed_axes else "C",
        stored=entry.compress_size,
        packed=packed,
    )
