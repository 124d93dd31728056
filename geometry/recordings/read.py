"""Reading a recording file: only what the format names, and never anything outside the file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from geometry.arguments import checked
from geometry.grids.grid import Grid
from geometry.surfaces.integers import narrowed

from .checks import refuse_implausible
from .errors import RecordingError
from .odd_files import brief, reading, refuse_oversized
from .opening_flux import GROUP, fluxes_of, is_flux
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
    "/nyquist": "velocity",
    "/pressure": "pressure",
    "/pressure_sigma": "pressure",
    "/wall/vertices": "length",
    "/wall/velocity": "velocity",
    "/wall/sigma": "length",
}
SOFT_LINKS = 16  # a chain longer than this is a circle


@checked
def read_recording(path: str | Path) -> Recording:
    """Read and validate a recording file.

    External links, external storage and virtual datasets are refused. Every shape is held against the others, and
    all that is declared against the size on the disk, before any values are read.

    Args:
        path: of the file.

    Returns:
        The recording; its velocity is 0 outside the mask, and may be NaN where the weight is 0.

    Raises:
        FileNotFoundError: there is no file.
        RecordingError: it is damaged, not a recording, or breaks one of the rules; names the file, the dataset, the
            rule and what to do.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    source = str(path)
    with reading(source, "file", "is not a readable HDF5 file"):
        file = h5py.File(path, "r")
    with reading(source, "file"), file:
        recording = _read(file, source, path.stat().st_size)
    check_recording(recording, source)
    refuse_implausible(recording, source)
    recording.velocity[~np.broadcast_to(recording.mask[:, None], recording.velocity.shape)] = 0
    return recording


@checked
def read_provenance(path: str | Path) -> dict[str, Any] | None:
    """What a file's attribute `provenance` says of its making; None where there is none, or it cannot be understood.

    Raises:
        FileNotFoundError: there is no file.
        RecordingError: it is no HDF5 file.
    """
    source = str(path)
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    with reading(source, "file", "is not a readable HDF5 file"):
        file = h5py.File(path, "r")
    with file:
        text = _text(file, "provenance", source)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _read(file: h5py.File, source: str, size: int) -> Recording:
    """The recording in a file of so many bytes."""
    dimension = _header(file, source)
    nodes = _datasets(file, source)
    outline = {dataset: _outline(node, dataset, kind, source) for dataset, (node, kind) in nodes.items()}
    velocity = outline["/velocity"]
    if velocity.ndim != dimension + 2:
        rule = f"must have {dimension + 2} axes in {dimension} dimensions, not the shape {velocity.shape}"
        raise RecordingError(source, "/velocity", rule)
    grid = _grid(file, dimension, velocity.shape[2:], source)
    _built(file, grid, outline, source)  # refuses shapes that disagree
    refuse_oversized({dataset: node for dataset, (node, _) in nodes.items()}, size, source)
    arrays = {}
    for dataset, (node, kind) in nodes.items():
        with reading(source, dataset):
            arrays[dataset] = _load(node, dataset, kind, source)
    return _built(file, grid, arrays, source)


def _datasets(file: h5py.File, source: str) -> dict[str, tuple[h5py.Dataset, type]]:
    """The datasets of the format that are there, with the types that they become, none of them read yet."""
    found: dict[str, tuple[h5py.Dataset, type]] = {}
    for _, dataset, kind in LAYOUT:
        with reading(source, dataset):
            node = _resolve(file, dataset, source)
            if node is not None:
                found[dataset] = _numbers(node, dataset, source), kind
        if node is None and dataset in REQUIRED:
            raise RecordingError(source, dataset, "is required but missing")
    for dataset in _flux_names(file, source):
        with reading(source, dataset):
            node = _resolve(file, dataset, source)
            if node is not None:
                found[dataset] = _numbers(node, dataset, source), np.float64
    there = [dataset for dataset in found if dataset.startswith("/wall/")]
    for dataset in OF_A_WALL if there else ():
        if dataset not in found:
            rule = f"is required but missing, beside {there[0]}; or leave all of /wall out"
            raise RecordingError(source, dataset, rule)
    return found


def _flux_names(file: h5py.File, source: str) -> list[str]:
    """The datasets of measured fluxes that are there; other names under /flux are none of the format's, or fixed."""
    with reading(source, GROUP):
        group = _resolve(file, GROUP, source)
        names = [f"{GROUP}/{name}" for name in group] if isinstance(group, h5py.Group) else []
    return sorted(name for name in names if is_flux(name))


def _outline(node: h5py.Dataset, dataset: str, kind: type, source: str) -> np.ndarray:
    """An array of the shape and type that the dataset will have, which takes no memory."""
    try:
        return np.broadcast_to(np.zeros((), kind), node.shape)
    except ValueError as fault:
        raise RecordingError(source, dataset, f"declares the shape {node.shape}, which no array can have") from fault


def _built(file: h5py.File, grid: Grid, arrays: Mapping[str, np.ndarray], source: str) -> Recording:
    names = {dataset: name for name, dataset, _ in LAYOUT}
    wall: dict[str, Any] = {names[d].removeprefix("wall."): a for d, a in arrays.items() if d.startswith("/wall/")}
    rest: dict[str, Any] = {names[d]: a for d, a in arrays.items() if d in names and not d.startswith("/wall/")}
    numbers: dict[str, Any] = {name: _number(file, name, source) for name in ("rho", "mu")}
    period = _number(file, "period", source) if "period" in file.attrs else 0.0
    cut = _number(file, "cut", source) if "cut" in file.attrs else 0.0
    if cut not in (0, 1):
        raise RecordingError(source, "attribute cut", f"must be 0 or 1, not {cut:g}")
    try:
        return Recording(
            grid=grid,
            wall=Wall(**wall) if wall else None,
            period=period,
            cut=bool(cut),
            description=_text(file, "description", source),
            fluxes=fluxes_of(arrays),
            **numbers,
            **rest,
        )
    except RecordingError as fault:
        raise RecordingError(source, fault.dataset, fault.rule) from fault


def _header(file: h5py.File, source: str) -> int:
    told = _text(file, "format", source)
    if told != "recording":
        raise RecordingError(source, "attribute format", f'must be "recording", not {brief(told)}')
    version = _number(file, "format_version", source)
    if version != 1:
        rule = f"must be 1, the version this reader knows, not {version:g}"
        raise RecordingError(source, "attribute format_version", rule)
    dimension = _number(file, "dimension", source) if "dimension" in file.attrs else 3
    if dimension not in (2, 3):
        raise RecordingError(source, "attribute dimension", f"must be 2 or 3, not {dimension:g}")
    return int(dimension)


def _text(file: h5py.File, name: str, source: str) -> str:
    """An attribute of text as plain text, whatever its bytes are: what is not UTF-8 becomes U+FFFD."""
    with reading(source, f"attribute {name}"):
        value = file.attrs.get(name, "")
        if isinstance(value, np.ndarray) and value.size == 1:  # as some writers store a single string
            value = value.reshape(-1)[0]
        if isinstance(value, h5py.Empty):
            return ""
        raw = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogateescape")
        return raw.decode("utf-8", "replace").replace("\0", "\N{REPLACEMENT CHARACTER}")


def _number(node: h5py.File | h5py.Dataset, name: str, source: str, dataset: str = "") -> float:
    """An attribute of one number, of the file or of a dataset."""
    place, rule = (dataset, f"its attribute {name} ") if dataset else (f"attribute {name}", "")
    with reading(source, place, f"{rule}cannot be read"):
        if name not in node.attrs:
            raise RecordingError(source, place, f"{rule}is required but missing")
        value = np.asarray(node.attrs[name])
        if value.size != 1 or value.dtype.kind not in "fiu":
            raise RecordingError(source, place, f"{rule}must be one number, not {brief(node.attrs[name])}")
        return float(value.reshape(()))


def _grid(file: h5py.File, dimension: int, shape: tuple[int, ...], source: str) -> Grid:
    with reading(source, "/grid"):
        group = _resolve(file, "/grid", source)
    if not isinstance(group, (h5py.Group, h5py.Dataset)):
        rule = "is required but missing: a group with the attributes origin and spacing"
        raise RecordingError(source, "/grid", rule)
    values = {}
    for name in ("origin", "spacing"):
        with reading(source, "/grid", f"its attribute {name} cannot be read"):
            if name not in group.attrs:
                raise RecordingError(source, "/grid", f"its attribute {name} is required but missing")
            value = np.asarray(group.attrs[name])
        if value.shape != (dimension,) or value.dtype.kind not in "fiu":
            rule = f"its attribute {name} must be {dimension} numbers (m), x first, not {brief(value)}"
            raise RecordingError(source, "/grid", rule)
        values[name] = tuple(value.astype(np.float64))
    try:
        return Grid(values["origin"], values["spacing"], shape)
    except ValueError as fault:
        raise RecordingError(source, "/grid", str(fault).removeprefix("Grid: ")) from fault


def _resolve(file: h5py.File, path: str, source: str) -> h5py.Group | h5py.Dataset | h5py.Datatype | None:
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
            target = [step for step in link.path.split("/") if step not in ("", ".")]
            todo = target + todo if link.path.startswith("/") else here + target + todo
            node, here = file, []
            continue
        if not isinstance(link, h5py.HardLink):
            raise RecordingError(source, path, f"is a link to data {ELSEWHERE}")
        node = node[part]
        here.append(part)
    return node


def _numbers(node: h5py.Group | h5py.Dataset | h5py.Datatype, dataset: str, source: str) -> h5py.Dataset:
    """The object as a dataset of numbers inside the file."""
    if not isinstance(node, h5py.Dataset):
        kind = "a group" if isinstance(node, h5py.Group) else "a named type"
        raise RecordingError(source, dataset, f"must be a dataset, not {kind}")
    if node.external is not None or node.is_virtual:
        raise RecordingError(source, dataset, f"keeps its data {ELSEWHERE}")
    if node.dtype.kind not in "fiub" or (node.dtype.kind == "b" and dataset in QUANTITIES):
        raise RecordingError(source, dataset, f"must be numbers, not {brief(node.dtype)}")
    if node.shape is None:
        raise RecordingError(source, dataset, "is an empty dataset without a shape; leave it out")
    settings = node.id.get_create_plist()
    for code, _, _, name in (settings.get_filter(number) for number in range(settings.get_nfilters())):
        if code not in FILTERS:
            raise RecordingError(source, dataset, f"is stored through {name!r}; use gzip, lzf or no compression")
    return node


def _load(node: h5py.Dataset, dataset: str, kind: type, source: str) -> np.ndarray:
    try:
        return narrowed(_unpacked(node, np.asarray(node[()]), dataset, source), kind)
    except RecordingError:
        raise
    except ValueError as fault:
        raise RecordingError(source, dataset, str(fault)) from fault


def _unpacked(node: h5py.Dataset, values: np.ndarray, dataset: str, source: str) -> np.ndarray:
    """Values in SI units: `scale_factor`, `add_offset`, `_FillValue` (CF 1.11, 2023, sec. 8.1) and `units` applied."""
    scale = [
        _number(node, name, source, dataset) if name in node.attrs else None
        for name in ("scale_factor", "add_offset", "_FillValue")
    ]
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
