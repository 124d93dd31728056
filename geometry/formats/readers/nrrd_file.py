"""NRRD images and Slicer's sequences (.nrrd, .nhdr, .seq.nrrd), by pynrrd."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from geometry.formats.source import FormatError, Source, missing_extra
from geometry.recordings.units import factor

from .streamed import Streamed

SPACES = {
    "left-posterior-superior": "lps",
    "lps": "lps",
    "right-anterior-superior": "ras",
    "ras": "ras",
}
VECTORS = ("vector", "3-vector", "2-vector", "covariant-vector", "3-color", "rgb-color")
SERIES = ("list", "time")
TYPES = {
    name: kind
    for kind, names in {
        "i1": ("signed char", "int8", "int8_t"),
        "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
        "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
        "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
        "i4": ("int", "signed int", "int32", "int32_t"),
        "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
        "i8": ("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"),
        "f4": ("float",),
        "f8": ("double",),
    }.items()
    for name in names
}


class Whole:
    """The values of a file in an encoding that pynrrd alone reads, all at once, when they are first asked for."""

    order = "F"

    def __init__(self, path: Path, shape: tuple[int, ...]) -> None:
        self._path, self.shape, self.dtype = path, shape, np.dtype(np.float64)

    @cached_property
    def _values(self) -> np.ndarray:
        import nrrd

        return nrrd.read(str(self._path), index_order="F")[0]

    def __getitem__(self, index: tuple) -> np.ndarray:
        return self._values[index]

    def close(self) -> None:
        """Let go of the values."""
        self.__dict__.pop("_values", None)


def _image(path: Path, header: dict[str, Any], start: int) -> Streamed | Whole:
    """The values of a file whose own would begin at `start`; x runs fastest and stands first.

    Raises:
        FormatError: the file with the values is missing or too small for them.
    """
    shape = tuple(int(size) for size in header["sizes"])
    encoding, detached = str(header.get("encoding", "")).lower(), header.get("data file", header.get("datafile"))
    kind = TYPES.get(str(header.get("type", "")).lower())
    skipped = int(header.get("line skip", header.get("lineskip", 0))) or int(header.get("byte skip", 0))
    if kind is None or encoding not in OPENED or skipped:
        return Whole(path, shape)
    place = path if detached is None else path.parent / str(detached)
    if not place.is_file():
        raise FormatError(f"{path}: its values lie in {place}, which is no file; put it there")
    dtype = np.dtype(kind).newbyteorder(">" if str(header.get("endian", "little")).lower() == "big" else "<")
    begin = start if detached is None else 0
    return Streamed(
        path,
        lambda: OPENED[encoding](place, begin),
        begin if encoding == "raw" else 0,
        shape,
        dtype,
        order="F",
        stored=place.stat().st_size - begin,
        packed=encoding != "raw",
    )


def _gunzipped(path: Path, start: int) -> IO[bytes]:
    file = path.open("rb")
    file.seek(start)
    stream = gzip.GzipFile(fileobj=file, mode="rb")
    stream.myfileobj = file  # type: ignore[assignment]  # is closed with it
    return cast(IO[bytes], stream)


OPENED: dict[str, Callable[[Path, int], IO[bytes]]] = {
    "raw": lambda path, _: path.open("rb"),
    "gzip": _gunzipped,
    "gz": _gunzipped,
}


def open_nrrd(path: Path) -> Source:
    """One array, named after the file, with the directions, units and times of its header."""
    try:
        import nrrd
    except ImportError as fault:
        raise missing_extra(path, "pynrrd") from fault
    try:
        with path.open("rb") as file:
            header = nrrd.read_header(file)
            start = file.tell()
    except (nrrd.NRRDError, OSError, ValueError) as fault:
        raise FormatError(f"{path}: is no readable NRRD file ({fault})") from fault
    image = _image(path, header, start)
    axes = _axes(header, len(image.shape), path)
    name = stem(path)
    world = SPACES.get(str(header.get("space", "")).lower(), "")
    if header.get("space") and not world and not str(header["space"]).endswith("dimensional"):
        world = _space(str(header["space"]), path)
    units = header.get("sample units") or header.get("units of values")
    return Source(
        str(path),
        {name: image},
        {name: {"units": str(units).strip('" ')} if units else {}},
        axes={name: axes},
        affine=_affine(header, axes, path),
        length=_length(header, bool(world)),
        world=world,
        time=_times(header, axes, image.shape),
        roles={"velocity": (name,)} if "c" in axes and image.shape[axes.index("c")] == 3 else {},
        close=image.close,
    )


def stem(path: Path) -> str:
    """The file's name without the format's own ends."""
    return path.name.removesuffix(".nrrd").removesuffix(".nhdr").removesuffix(".seq")


def _space(name: str, path: Path) -> str:
    raise FormatError(f"{path}: its space is {name!r}; known are left-posterior-superior and right-anterior-superior")


def _axes(header: dict[str, Any], count: int, path: Path) -> str:
    kinds = [str(kind).lower() for kind in header.get("kinds", [])] or ["domain"] * count
    letters, space = "", iter("xyz")
    for kind in kinds:
        if kind in VECTORS:
            letters += "c"
        elif kind in SERIES:
            letters += "t"
        else:
            letters += next(space, "?")
    return letters if "?" not in letters and len(set(letters)) == count else ""


def _affine(header: dict[str, Any], axes: str, path: Path) -> np.ndarray | None:
    directions = header.get("space directions")
    if directions is None:
        if "spacings" not in header:
            return None
        spacing = [float(value) for value in header["spacings"]]
        used = [value for value, letter in zip(spacing, axes, strict=True) if letter in "xyz"]
        return np.diag([*used, 1.0])
    rows = [np.asarray(row, np.float64) for row in directions if row is not None and np.isfinite(row).all()]
    dimension = len(rows)
    if any(row.shape != (dimension,) for row in rows):
        raise FormatError(f"{path}: its space directions are not {dimension} vectors of {dimension} numbers")
    affine = np.eye(dimension + 1)
    affine[:-1, :-1] = np.stack(rows, axis=1)
    affine[:-1, -1] = header.get("space origin", np.zeros(dimension))
    return affine


def _length(header: dict[str, Any], patient: bool) -> float | None:
    """The unit of its lengths; coordinates of a patient are in mm where it does not say, as Slicer takes them."""
    units = [str(unit).strip('"') for unit in header.get("space units", []) if str(unit).strip('"')]
    if units:
        return factor(units[0], "length")
    return 1e-3 if patient else None


def _times(header: dict[str, Any], axes: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Slicer's sequences list the values of their index axis; others have a spacing of the axis of times."""
    if "t" not in axes:
        return None
    axis = axes.index("t")
    values, unit = (
        header.get("axis 0 index values"),
        header.get("axis 0 index unit") or header.get("axis 0 index units"),
    )
    if values is not None and axis == 0:
        words = str(values).replace('"', " ").split()
        return np.array([float(word) for word in words]) * (factor(str(unit), "time") if unit else 1.0)
    spacing, units = header.get("spacings"), header.get("units")
    if spacing is None or units is None or not np.isfinite(spacing[axis]):
        return None
    return float(spacing[axis]) * np.arange(shape[axis]) * factor(str(units[axis]), "time")
