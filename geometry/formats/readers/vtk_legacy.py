"""Legacy VTK files of structured points in binary, whose arrays are read in parts; vtk itself reads them whole."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO
from urllib.parse import unquote

import numpy as np

from geometry.formats.source import FormatError

from .streamed import Streamed

TYPES = {
    "char": "i1",
    "signed_char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
    "float": "f4",
    "double": "f8",
}
LINE = 4096  # bytes of the longest line of text


class NotPlain(Exception):
    """The file holds something that is not read here."""


@dataclass
class LegacyImage:
    """What a file says, and its point arrays.

    Attributes:
        counts: nodes along x, y, z.
        spacing: along x, y, z.
        origin: of the first node.
        arrays: by name, indexed [z, y, x] or [z, y, x, c].
        time: stated, or None.
    """

    counts: tuple[int, int, int] = (0, 0, 0)
    spacing: tuple[float, ...] = (1.0, 1.0, 1.0)
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)
    arrays: dict[str, Streamed] = field(default_factory=dict)
    time: float | None = None


def read_legacy(path: Path) -> LegacyImage | None:
    """The image in a file, None where vtk has to read it: text, turned axes or another kind of data.

    Raises:
        FormatError: the file claims more values than it holds.
    """
    with path.open("rb") as file:
        try:
            head = [file.readline(LINE).strip() for _ in range(4)]
            if not head[0].startswith(b"# vtk DataFile") or head[2].upper() != b"BINARY":
                return None
            if head[3].upper().split() != [b"DATASET", b"STRUCTURED_POINTS"]:
                return None
            return _Parser(path, file).image()
        except FormatError:
            raise
        except (NotPlain, ValueError, KeyError, IndexError):
            return None


class _Parser:
    """Goes through a file keyword by keyword and steps over the values."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self._path, self._file, self._size = path, file, path.stat().st_size
        self._image, self._points = LegacyImage(), False

    def image(self) -> LegacyImage:
        while True:
            line = self._file.readline(LINE)
            if not line:
                return self._image
            words = line.decode("ascii").split()
            if words:
                self._keyword(words[0].upper(), words[1:])

    def _keyword(self, key: str, rest: list[str]) -> None:
        if key == "DIMENSIONS":
            nx, ny, nz = map(int, rest)
            self._image.counts = (nx, ny, nz)
        elif key in ("SPACING", "ASPECT_RATIO"):
            self._image.spacing = tuple(map(float, rest))
        elif key == "ORIGIN":
            self._image.origin = tuple(map(float, rest))
        elif key == "POINT_DATA":
            self._points = int(rest[0]) == math.prod(self._image.counts)
            if not self._points:
                raise NotPlain
        elif key in ("VECTORS", "NORMALS"):
            self._array(rest[0], rest[1], 3)
        elif key == "SCALARS":
            if not self._file.readline(LINE).upper().startswith(b"LOOKUP_TABLE"):
                raise NotPlain
            self._array(rest[0], rest[1], int(rest[2]) if len(rest) > 2 else 1)
        elif key == "FIELD":
            self._fields(int(rest[1]))
        elif key == "METADATA":
            while self._file.readline(LINE).strip():
                pass
        else:
            raise NotPlain

    def _fields(self, count: int) -> None:
        for _ in range(count):
            words: list[str] = []
            while not words:
                line = self._file.readline(LINE)
                if not line:
                    raise NotPlain
                words = line.decode("ascii").split()
                if words == ["METADATA"]:
                    self._keyword("METADATA", [])
                    words = []
            name, components, tuples, kind = words
            if self._points:
                if int(tuples) != math.prod(self._image.counts):
                    raise NotPlain
                self._array(name, kind, int(components))
            else:
                self._stated(name, int(components) * int(tuples), kind)

    def _stated(self, name: str, count: int, kind: str) -> None:
        dtype = np.dtype(TYPES[kind.lower()]).newbyteorder(">")
        data = self._file.read(dtype.itemsize * min(count, LINE))
        if name.upper() in ("TIMEVALUE", "TIME") and count == 1:
            self._image.time = float(np.frombuffer(data, dtype)[0])
        elif count > LINE:
            raise NotPlain

    def _array(self, name: str, kind: str, components: int) -> None:
        dtype, start = np.dtype(TYPES[kind.lower()]).newbyteorder(">"), self._file.tell()
        shape = (*reversed(self._image.counts), *((components,) if components > 1 else ()))
        try:
            self._image.arrays[unquote(name)] = Streamed(
                self._path,
                lambda: self._path.open("rb"),
                start,
                shape,
                dtype,
                order="C",
                stored=self._size - start,
                packed=False,
            )
        except FormatError as fault:
            raise FormatError(f"{fault} ({name})") from fault
        self._file.seek(start + math.prod(shape) * dtype.itemsize)
