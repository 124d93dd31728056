"""What an export says of its recording beyond the fields that its format holds, so that it comes back whole.

A text in JSON: numbers, the grid, the names of the fields, and every array that is no field of the grid (walls, valves,
fluxes) as it was, packed. Each writer puts it where its format has a place for it.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geometry.grids.grid import Grid
from geometry.recordings.errors import RecordingError
from geometry.recordings.opening_flux import fluxes_of
from geometry.recordings.recording import LAYOUT, Recording, Wall

from ..source import FormatError

MARK = "torchsph_recording"
SOURCE = "torchsph_source"  # in the place of the mark, the file beside it whose values are shown
FIELDS = ("velocity", "mask", "weight", "sigma", "pressure", "pressure_sigma", "beam", "normal")
NUMBERS = ("rho", "mu", "period")
TYPES = ("<f8", "<f4", "<i8", "<i4", "|u1", "|b1")
LARGEST = 1 << 30  # bytes of one array that is packed


def marked(recording: Recording, held: Sequence[str] = FIELDS) -> str:
    """The text that a recording's export carries, whose files hold the fields `held`."""
    grid, arrays = recording.grid, recording.arrays()
    content: dict[str, object] = {"version": 1, "description": recording.description, "cut": recording.cut}
    content |= {name: float(getattr(recording, name)) for name in NUMBERS}
    content |= {"origin": list(grid.origin), "spacing": list(grid.spacing), "shape": list(grid.shape)}
    content["fields"] = [name for name in held if f"/{name}" in arrays]
    content["arrays"] = {name: _packed(values) for name, values in arrays.items() if name[1:] not in held}
    return json.dumps(content)


@dataclass(frozen=True, eq=False)
class Mark:
    """What such a text says.

    Attributes:
        path: of the file that has it, for messages.
        grid: of the fields.
        fields: which of `FIELDS` the files hold.
        about: rho, mu, period, description, cut.
        arrays: everything else, by the names of a recording's datasets.
    """

    path: Path
    grid: Grid
    fields: tuple[str, ...]
    about: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    @classmethod
    def read(cls, text: str, path: Path) -> Mark:
        """The mark of a file.

        Raises:
            FormatError: it is damaged.
        """
        try:
            content = json.loads(text)
            shape = tuple(int(size) for size in content["shape"])
            places = (tuple(float(value) for value in content[name]) for name in ("origin", "spacing"))
            about = {name: float(content[name]) for name in NUMBERS}
            about |= {"description": str(content["description"]), "cut": bool(content["cut"])}
            fields = tuple(name for name in FIELDS if name in content["fields"])
            arrays = {str(name): _unpacked(one) for name, one in content["arrays"].items()}
            grid = Grid(*places, shape)
            if "/time" not in arrays or "velocity" not in fields or grid.dimension not in (2, 3):
                raise ValueError("times, velocity or grid are missing")
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError, zlib.error) as fault:
            raise FormatError(
                f"{path}: {MARK}, which export wrote for the way back, is damaged ({type(fault).__name__}: "
                f"{str(fault)[:100]}); export it again, or say what is what (--velocity ... --length-unit m)"
            ) from fault
        return cls(path, grid, fields, about, arrays)

    def recording(self, fields: Mapping[str, np.ndarray]) -> Recording:
        """The recording that was exported.

        Args:
            fields: arrays of `self.fields`, indexed as in a recording.

        Raises:
            FormatError: they are not those of the mark.
            RecordingError: what comes out is no recording.
        """
        arrays = {**self.arrays, **{f"/{name}": values for name, values in fields.items()}}
        found = {name: arrays[dataset] for name, dataset, _ in LAYOUT if dataset in arrays}
        wall: dict[str, Any] = {name[5:]: array for name, array in found.items() if name.startswith("wall.")}
        rest: dict[str, Any] = {name: array for name, array in found.items() if not name.startswith("wall.")}
        try:
            surface = Wall(**wall) if wall else None
            return Recording(grid=self.grid, wall=surface, fluxes=fluxes_of(arrays), **rest, **self.about)
        except (RecordingError, TypeError) as fault:
            said = f"{fault.dataset} {fault.rule}" if isinstance(fault, RecordingError) else str(fault)
            raise FormatError(
                f"{self.path}: its fields are not those that were exported ({said}); export it again, or say what is "
                "what (--velocity ... --length-unit m)"
            ) from fault


def _packed(values: np.ndarray) -> dict[str, object]:
    values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
    data = base64.b64encode(zlib.compress(values.tobytes(), 6)).decode("ascii")
    return {"shape": list(values.shape), "type": values.dtype.str, "data": data}


def _unpacked(one: Mapping[str, Any]) -> np.ndarray:
    shape, kind = tuple(int(size) for size in one["shape"]), str(one["type"])
    if kind not in TYPES or len(shape) > 6 or any(size < 0 for size in shape):
        raise ValueError(f"an array of {kind} and the shape {shape[:8]}")
    size = np.dtype(kind).itemsize * math.prod(shape)
    try:
        packed = base64.b64decode(one["data"], validate=True)
    except binascii.Error as fault:
        raise ValueError(str(fault)) from fault
    if size > LARGEST:
        raise ValueError(f"an array of {size} bytes")
    data = zlib.decompressobj().decompress(packed, size + 1)
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes for the shape {shape}")
    return np.frombuffer(data, kind).reshape(shape).copy()
