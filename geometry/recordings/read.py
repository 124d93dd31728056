"""Reading a recording file: only what the format names, and never anything outside the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from geometry.grids.grid import Grid

from .checks import refuse_implausible
from .errors import RecordingError
from .recording import LAYOUT, OF_A_WALL, REQUIRED, Recording, Wall
from .rules import check_recording
from .units import factor

ELSEWHERE = "in another file, which is never followed; copy the data into this file"
# HDF5 filters: deflate (gzip), shuffle, fletcher32, lzf. Others would load code from plug-ins.
FILTERS = {1, 2, 3, 32000}
# Datasets whose attribute `units` is obeyed, and what they are.
QUANTITIES = {
    "/time": "time",
    "/velocity": "velocity",
    "/sigma": "velocity",
    "/pressure": "pressure",
    "/wall/vertices": "length",
    "/wall/velocity": "velocity",
}
SOFT_LINKS = 16  # a chain longer than this is a circle


def read_recording(path: str | Path) -> Recording:
    """Read and validate a recording file.

    External links, external storage and virtual datasets are refused. The velocity comes back as 0 outside the mask,
    and may be NaN where the weight is 0.

    Raises:
        FileNotFoundError: there is no file.
        RecordingError: it is not a recording or breaks one of the rules; the text names the file, the dataset, the
            rule and what to do.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    source = str(path)
    try:
        file = h5py.File(path, "r")
    except OSError as fault:
        raise RecordingError(source, "file", f"is not a readable HDF5 file ({fault})") from fault
    with file:
        try:
            recording = _read(file, source)
        except OSError as fault:
            raise RecordingError(source, "file", f"is damaged: {fault}") from fault
    check_recording(recording, source)
    refuse_implausible(recording, source)
    recording.velocity[~np.broadcast_to(recording.mask[:, None], recording.velocity.shape)] = 0
    return recording


def _read(file: h5py.File, source: str) -> Recording:
    dimension = _header(file, source)
    arrays: dict[str, np.ndarray] = {}
    for _, dataset, kind in LAYOUT:
        node = _resolve(file, dataset, source)
        if node is None and dataset in REQUIRED:
            raise RecordingError(source, dataset, "is required but missing")
        if node is not None:
            arrays[dataset] = _load(node, dataset, kind, source)
    there = [dataset for dataset in arrays if dataset.startswith("/wall/")]
    for dataset in OF_A_WALL if there else ():
        if dataset not in arrays:
            raise RecordingError(
                source, dataset, f"is required but missing, beside {there[0]}; or leave all of /wall out"
            )
    velocity = arrays["/velocity"]
    if velocity.ndim != dimension + 2:
        rule = f"must have {dimension + 2} axes in {dimension} dimensions, not the shape {velocity.shape}"
        raise RecordingError(source, "/velocity", rule)
    grid = _grid(file, dimension, velocity.shape[2:], source)
    names = {dataset: name for name, dataset, _ in LAYOUT}
    wall: dict[str, Any] = {names[d].removeprefix("wall."): a for d, a in arrays.items() if d.startswith("/wall/")}
    rest: dict[str, Any] = {names[d]: a for d, a in arrays.items() if not d.startswith("/wall/")}
    numbers: dict[str, Any] = {name: _number(file, name, source) for name in ("rho", "mu")}
    period = _number(file, "period", source) if "period" in file.attrs else 0.0
    try:
        return Recording(
            grid=grid,
            wall=Wall(**wall) if wall else None,
            period=period,
            description=_text(file, "description"),
            **numbers,
            **rest,
        )
    except RecordingError as fault:
        raise RecordingError(source, fault.dataset, fault.rule) from fault


def _header(file: h5py.File, source: str) -> int:
    if _text(file, "format") != "recording":
        raise RecordingError(source, "attribute format", f'must be "recording", not {_text(file, "format")!r}')
    version = _number(file, "format_version", source)
    if version != 1:
        rule = f"must be 1, the version this reader knows, not {version:g}"
        raise RecordingError(source, "attribute format_version", rule)
    dimension = _number(file, "dimension", source) if "dimension" in file.attrs else 3
    if dimension not in (2, 3):
        raise RecordingError(source, "attribute dimension", f"must be 2 or 3, not {dimension:g}")
    return int(dimension)


def _text(file: h5py.File, name: str) -> str:
    value = file.attrs.get(name, "")
    if isinstance(value, np.ndarray) and value.size == 1:  # as some writers store a single string
        value = value.reshape(-1)[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _number(file: h5py.File, name: str, source: str) -> float:
    if name not in file.attrs:
        raise RecordingError(source, f"attribute {name}", "is required but missing")
    value = np.asarray(file.attrs[name])
    if value.size != 1 or value.dtype.kind not in "fiu":
        raise RecordingError(source, f"attribute {name}", f"must be one number, not {file.attrs[name]!r}")
    return float(value.reshape(()))


def _grid(file: h5py.File, dimension: int, shape: tuple[int, ...], source: str) -> Grid:
    group = _resolve(file, "/grid", source)
    if group is None:
        rule = "is required but missing: a group with the attributes origin and spacing"
        raise RecordingError(source, "/grid", rule)
    values = {}
    for name in ("origin", "spacing"):
        if name not in group.attrs:
            raise RecordingError(source, "/grid", f"its attribute {name} is required but missing")
        value = np.asarray(group.attrs[name])
        if value.shape != (dimension,) or value.dtype.kind not in "fiu":
            rule = f"its attribute {name} must be {dimension} numbers (m), x first, not {value!r}"
            raise RecordingError(source, "/grid", rule)
        values[name] = tuple(value.astype(np.float64))
    try:
        return Grid(values["origin"], values["spacing"], shape)
    except ValueError as fault:
        raise RecordingError(source, "/grid", str(fault).removeprefix("Grid: ")) from fault


def _resolve(file: h5py.File, path: str, source: str) -> h5py.Group | h5py.Dataset | None:
    """The object at a path, reached through links inside this file only; None where there is none."""
    node: h5py.Group = file
    todo, jumps = [part for part in path.split("/") if part], 0
    here: list[str] = []
    while todo:
        part = todo.pop(0)
        link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            return None
        if isinstance(link, h5py.SoftLink):
            jumps += 1
            if jumps > SOFT_LINKS:
                raise RecordingError(source, path, "is a circle of soft links")
            target = [step for step in link.path.split("/") if step]
            todo = target + todo if link.path.startswith("/") else here + target + todo
            node, here = file, []
            continue
        if not isinstance(link, h5py.HardLink):
            raise RecordingError(source, path, f"is a link to data {ELSEWHERE}")
        node = node[part]
        here.append(part)
    return node


def _load(node: h5py.Group | h5py.Dataset, dataset: str, kind: type, source: str) -> np.ndarray:
    if not isinstance(node, h5py.Dataset):
        raise RecordingError(source, dataset, "must be a dataset, not a group")
    if node.external is not None or node.is_virtual:
        raise RecordingError(source, dataset, f"keeps its data {ELSEWHERE}")
    if node.dtype.kind not in "fiub":
        raise RecordingError(source, dataset, f"must be numbers, not {node.dtype}")
    settings = node.id.get_create_plist()
    for code, _, _, name in (settings.get_filter(number) for number in range(settings.get_nfilters())):
        if code not in FILTERS:
            raise RecordingError(source, dataset, f"is stored through {name!r}; use gzip, lzf or no compression")
    values = _unpacked(node, np.asarray(node[()]), dataset, source)
    if kind in (np.bool_, np.int32, np.uint8, np.int64):
        _check_integers(values, dataset, kind, source)
    with np.errstate(over="ignore"):  # a float64 too large for float32 becomes inf, which the rules then report
        return values.astype(kind)


def _unpacked(node: h5py.Dataset, values: np.ndarray, dataset: str, source: str) -> np.ndarray:
    """Values in SI units: `scale_factor`, `add_offset`, `_FillValue` (CF 1.11, 2023, sec. 8.1) and `units` applied."""
    scale = [_packing(node, name, dataset, source) for name in ("scale_factor", "add_offset", "_FillValue")]
    if scale[0] is None and scale[1] is None:
        if dataset in QUANTITIES and values.dtype.kind in "iu" and values.any():
            rule = "holds integers without an attribute scale_factor; they are packed or in another unit than SI"
            raise RecordingError(source, dataset, f"{rule}: store floating-point numbers")
    else:
        plain = values * np.float64(1.0 if scale[0] is None else scale[0]) + (scale[1] or 0.0)
        values = plain if scale[2] is None else np.where(values == scale[2], np.nan, plain)
    units = node.attrs.get("units")
    if units is None or dataset not in QUANTITIES:
        return values
    text = units.decode("utf-8", "replace") if isinstance(units, bytes) else str(units)
    try:
        unit = factor(text, QUANTITIES[dataset])
    except ValueError as fault:
        raise RecordingError(source, dataset, f"its attribute units: {fault}") from fault
    return values if unit == 1 else values * unit


def _packing(node: h5py.Dataset, name: str, dataset: str, source: str) -> float | None:
    if name not in node.attrs:
        return None
    value = np.asarray(node.attrs[name])
    if value.size != 1 or value.dtype.kind not in "fiu":
        raise RecordingError(source, dataset, f"its attribute {name} must be one number, not {node.attrs[name]!r}")
    return float(value.reshape(()))


def _check_integers(values: np.ndarray, dataset: str, kind: type, source: str) -> None:
    """Refuse what a conversion to a narrower type would change without a word."""
    lower, upper = (0, 1) if kind is np.bool_ else (np.iinfo(kind).min, np.iinfo(kind).max)
    if values.size and not ((values >= lower) & (values <= upper)).all():
        meaning = "0 and 1 only" if kind is np.bool_ else f"integers from {lower} to {upper}"
        raise RecordingError(source, dataset, f"must hold {meaning}, not {values.min()} to {values.max()}")
    if values.dtype.kind == "f" and (values != np.rint(values)).any():
        raise RecordingError(source, dataset, "must hold integers")
