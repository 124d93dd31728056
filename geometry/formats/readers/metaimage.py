"""MetaImage (.mha, .mhd), by SimpleITK: places and vectors in LPS, mm."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from geometry.formats.source import FormatError, Source, missing_extra


class Image:
    """The pixels of a file, indexed [t, z, y, x, c], read when they are first asked for."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader
        components = reader.GetNumberOfComponents()
        self.shape = tuple(reversed(reader.GetSize())) + ((components,) if components > 1 else ())
        self.dtype = np.dtype(np.float64)

    @cached_property
    def _values(self) -> np.ndarray:
        import SimpleITK

        return SimpleITK.GetArrayFromImage(self._reader.Execute())

    def __getitem__(self, index: tuple) -> np.ndarray:
        return self._values[index]


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
    count, image = reader.GetDimension(), Image(reader)
    space = min(count, 3)
    affine = np.eye(space + 1)
    direction = np.array(reader.GetDirection()).reshape(count, count)[:space, :space]
    affine[:-1, :-1] = direction * np.array(reader.GetSpacing()[:space])
    affine[:-1, -1] = reader.GetOrigin()[:space]
    vector = len(image.shape) > count
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
    )
