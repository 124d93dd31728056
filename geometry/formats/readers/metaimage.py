"""MetaImage (.mha, .mhd): what it says of itself by SimpleITK, places and vectors in LPS, mm."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from geometry.formats.source import FormatError, Source, missing_extra

from .streamed import Inflated, Streamed

TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG_LONG": "i8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
HEADER = 1 << 16  # bytes that the text before the values may take
BIG = ("true", "1", "t")


class Whole:
    """The pixels of a file that SimpleITK alone reads, as one of many parts, when they are first asked for."""

    def __init__(self, reader: Any, shape: tuple[int, ...]) -> None:
        self._reader, self.shape, self.dtype = reader, shape, np.dtype(np.float64)

    @cached_property
    def _image(self) -> Any:
        return self._reader.Execute()

    def __getitem__(self, index: tuple) -> np.ndarray:
        import SimpleITK

        return SimpleITK.GetArrayViewFromImage(self._image)[index]

    def close(self) -> None:
        """Let go of the pixels."""
        self.__dict__.pop("_image", None)


def open_metaimage(path: Path) -> Source:
    """One array, named after the file; a fourth axis is time, in the unit that --time-unit says (else s)."""
    try:
        import SimpleITK
    except ImportError as fault:
        raise missing_extra(path, "SimpleITK") from fault
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        reader.ReadImageInformation()
    except RuntimeError as fault:
        raise FormatError(f"{path}: is no readable MetaImage ({str(fault).splitlines()[-1]})") from fault
    count, components = reader.GetDimension(), reader.GetNumberOfComponents()
    image = _image(path, reader, tuple(reversed(reader.GetSize())) + ((components,) if components > 1 else ()))
    space = min(count, 3)
    affine = np.eye(space + 1)
    direction = np.array(reader.GetDirection()).reshape(count, count)[:space, :space]
    affine[:-1, :-1] = direction * np.array(reader.GetSpacing()[:space])
    affine[:-1, -1] = reader.GetOrigin()[:space]
    vector = components > 1
    name = path.name.partition(".")[0]
    time = None
    if count == 4:
        time = reader.GetOrigin()[3] + reader.GetSpacing()[3] * np.arange(image.shape[0])
    return Source(
        str(path),
        {name: image},
        axes={name: "tzyx"[4 - count :] + ("c" if vector else "")},
        affine=affine,
        length=1e-3,
        world="lps",
        time=time,
        roles={"velocity": (name,)} if vector else {},
        close=image.close,
    )


def _image(path: Path, reader: Any, shape: tuple[int, ...]) -> Streamed | Whole:
    """The pixels, indexed [t, z, y, x, c], where they are one stream of bytes; else by SimpleITK."""
    said, start = _header(path)
    place, kind = said.get("elementdatafile", ""), TYPES.get(said.get("elementtype", ""))
    skipped = said.get("headersize", "0") != "0" or said.get("binarydata", "True").lower() == "false"
    if kind is None or skipped or place.upper() == "LIST" or "%" in place or not place:
        return Whole(reader, shape)
    local = place.upper() == "LOCAL"
    file = path if local else path.parent / place
    if not file.is_file():
        raise FormatError(f"{path}: its values lie in {file}, which is no file; put it there")
    big = said.get("binarydatabyteordermsb", said.get("elementbyteordermsb", "False")).lower() in BIG
    packed = said.get("compresseddata", "False").lower() in BIG
    begin = start if local else 0
    return Streamed(
        path,
        lambda: Inflated(file.open("rb"), begin) if packed else file.open("rb"),  # type: ignore[arg-type, return-value]
        0 if packed else begin,
        shape,
        np.dtype(kind).newbyteorder(">" if big else "<"),
        order="C",
        stored=file.stat().st_size - begin,
        packed=packed,
    )


def _header(path: Path) -> tuple[dict[str, str], int]:
    """What the text at the head of a file says, keys in lower case, and where it ends: after `ElementDataFile`."""
    with path.open("rb") as file:
        head = file.read(HEADER)
    said: dict[str, str] = {}
    at = 0
    while True:
        end = head.find(b"\n", at)
        line = head[at : end if end >= 0 else len(head)].decode("latin-1")
        key, equals, value = line.partition("=")
        if not equals:
            return said, at
        said[key.strip().lower()] = value.strip()
        at = end + 1 if end >= 0 else len(head)
        if key.strip().lower() == "elementdatafile" or end < 0:
            return said, at
