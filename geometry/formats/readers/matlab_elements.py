"""The arrays of a MATLAB version 5 to 7 file as streams of numbers.

Read here because SciPy unpacks a variable whole, beside what becomes of it. The layout is that of MathWorks, "MAT-File
Format" (2024), chapter 1: elements of a tag and its data, compressed ones around one matrix each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from geometry.formats.source import FormatError

from .streamed import Inflated, Streamed

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
MATRIX, COMPRESSED = 14, 15
COMPLEX = 0x800  # among the flags of an array
HEAD = 128  # bytes before the first element
MOST_AXES = 64
LONGEST_NAME = 4096


def element(path: Path, name: str, shape: tuple[int, ...]) -> Streamed:
    """The real part of a variable, whose first axis runs fastest.

    Args:
        path: of the file.
        name: of the variable.
        shape: of it.

    Raises:
        FormatError: the file does not hold it as it says, or holds too few bytes for it.
    """
    try:
        for start, size, packed, order in _elements(path):
            stream: IO[bytes] = _unpacked(path, start) if packed else path.open("rb")
            with stream:
                if not packed:
                    stream.seek(start)
                found = _variable(stream, order)
                if found is None or found[0] != name:
                    continue
                first = found[1] if packed else stream.tell()
            return Streamed(
                path,
                partial(_unpacked, path, start) if packed else partial(_plain, path),
                first,
                shape,
                np.dtype(order + found[2]),
                order="F",
                stored=size,
                packed=packed,
            )
    except (struct.error, EOFError, OSError) as fault:
        raise FormatError(f"{path}: {name}: is damaged; save the file again") from fault
    raise FormatError(f"{path}: {name}: is no array of real numbers as MATLAB 5 to 7 stores them; save it with -v7")


def _elements(path: Path) -> Iterator[tuple[int, int, bool, str]]:
    """Start and size of the data of each element, whether they are compressed, and the byte order."""
    end = path.stat().st_size
    with path.open("rb") as file:
        order = ">" if file.read(HEAD)[-2:] == b"MI" else "<"
        at = HEAD
        while at + 8 <= end:
            file.seek(at)
            kind, size = struct.unpack(f"{order}II", file.read(8))
            if kind in (MATRIX, COMPRESSED):
                yield at + 8, min(size, end - at - 8), kind == COMPRESSED, order
            at += 8 + size + (-size % 8 if kind != COMPRESSED else 0)


def _plain(path: Path) -> IO[bytes]:
    return path.open("rb")


def _unpacked(path: Path, start: int) -> IO[bytes]:
    return Inflated(path.open("rb"), start)  # type: ignore[return-value]


def _variable(stream: IO[bytes], order: str) -> tuple[str, int, str] | None:
    """Name, where the numbers begin and their type, of the matrix at hand; None where it holds none."""
    counted = _Counted(stream, order)
    kind, size = counted.tag()[:2] if isinstance(stream, Inflated) else (MATRIX, 0)
    if kind != MATRIX:
        return None
    flags = counted.part(16)
    if int(flags[0]) & 0xFF not in range(6, 16) or int(flags[0]) & COMPLEX:
        return None
    counted.part(4 * MOST_AXES)
    name = counted.part(LONGEST_NAME, text=True)
    kind, _ = counted.tag()
    if kind not in TYPES:
        raise EOFError
    return str(name), counted.at, TYPES[kind]


class _Counted:
    """A stream from whose beginning bytes are counted."""

    def __init__(self, stream: IO[bytes], order: str) -> None:
        self._stream, self._order, self.at = stream, order, 0
        self._small = b""

    def take(self, count: int) -> bytes:
        """So many bytes.

        Raises:
            EOFError: there are fewer.
        """
        got = b""
        while len(got) < count:
            more = self._stream.read(count - len(got))
            if not more:
                raise EOFError
            got += more
        self.at += count
        return got

    def tag(self) -> tuple[int, int]:
        """Kind and size of what follows; data of up to four bytes stand in the tag itself."""
        (word,) = struct.unpack(f"{self._order}I", self.take(4))
        if word >> 16:
            self._small = b"small"
            return word & 0xFFFF, word >> 16
        self._small = b""
        (size,) = struct.unpack(f"{self._order}I", self.take(4))
        return word, size

    def part(self, most: int, *, text: bool = False) -> tuple[int, ...] | str:
        """A whole element of at most so many bytes, as whole numbers or as text."""
        _, size = self.tag()
        if size > most:
            raise EOFError
        data = self.take(4 if self._small else size + -size % 8)[:size]
        return data.decode("latin-1") if text else struct.unpack(f"{self._order}{size // 4}I", data[: size // 4 * 4])
