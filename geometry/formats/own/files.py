"""Exports on their way back: where each format keeps the mark, which files belong together, what is what in them."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from geometry.recordings.odd_files import PACKED, UNWRITTEN
from geometry.recordings.read import read_recording
from geometry.recordings.recording import Recording

from ..assemble import Fields
from ..field_map import FieldMap
from ..labelled_arrays import from_xarray
from ..series import read_fields
from ..source import FormatError
from .mark import MARK, SOURCE, Mark

SCALARS = ("pressure", "pressure_sigma")
LONGEST = 1 << 30  # characters of a mark


def own_recording(paths: Sequence[Path]) -> Recording | None:
    """The recording that `export` made these files of; None where it did not make them.

    Args:
        paths: the main file of an export, or the images of its frames.

    Raises:
        FormatError: a file of the export is missing or damaged.
    """
    main = _main(paths)
    kind = None if main is None else _kind(main)
    if main is None or kind is None:
        return None
    source = _shown(main) if kind == "vtkhdf" else None
    if source is not None:
        return source
    text = _text(main, kind)
    if text is None:
        return None
    if kind == "netcdf":
        return _of_dataset(main)
    mark = Mark.read(text, main)
    files, said = LAYOUTS[kind](main, mark)
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise FormatError(f"{missing[0]}: belongs to {main.name} and is not there; put it beside that file")
    return mark.recording(_fields(files, said, mark))


def _main(paths: Sequence[Path]) -> Path | None:
    """The file with the mark: the only one, or the series of which the files are all frames."""
    first = paths[0]
    if not first.name.endswith(".vti"):
        return first if len(paths) == 1 and first.is_file() else None
    series = first.with_name(re.sub(r"_\d+\.vti$", ".vti.series", first.name))
    listed = _listed(series) if series != first and series.is_file() else []
    return series if listed and listed == [path.resolve() for path in paths] else None


def _kind(path: Path) -> str | None:
    ends = {
        ".npz": "npz",
        ".mat": "mat",
        ".vtkhdf": "vtkhdf",
        ".vti.series": "vti",
        ".nii.gz": "nifti",
        ".nii": "nifti",
        ".nrrd": "nrrd",
        ".nc": "netcdf",
    }
    return next((kind for end, kind in ends.items() if path.name.lower().endswith(end)), None)


# --- the mark ----------------------------------------------------------------------------------------


def _text(path: Path, kind: str) -> str | None:
    """The mark of a file; None where it has none or cannot be read, which its own reader then tells better."""
    try:
        text = TEXTS[kind](path)
    except Exception:  # the readers of many packages, each with errors of its own
        return None
    return text if isinstance(text, str) and 0 < len(text) <= LONGEST else None


def _of_npz(path: Path) -> str | None:
    with zipfile.ZipFile(path) as archive:
        if f"{MARK}.npy" not in archive.namelist() or archive.getinfo(f"{MARK}.npy").file_size > 4 * LONGEST:
            return None
    with np.load(path, allow_pickle=False) as content:
        return str(content[MARK][()])


def _of_matlab(path: Path) -> str | None:
    from scipy.io import loadmat

    found = None if h5py.is_hdf5(path) else loadmat(str(path), variable_names=[MARK]).get(MARK)
    return None if found is None else str(np.asarray(found).reshape(-1)[0])


def _of_vtkhdf(path: Path) -> str | None:
    with h5py.File(path, "r") as file:
        hard = isinstance(file.get(MARK, getlink=True), h5py.HardLink)
        node = file[MARK] if hard else None
        own = isinstance(node, h5py.Dataset) and node.shape == () and node.external is None
        value = node[()] if own else None
    return value.decode("utf-8") if isinstance(value, bytes) else None


def _of_series(path: Path) -> str | None:
    return json.loads(path.read_text(encoding="utf-8"))[MARK]


def _of_nifti(path: Path) -> str | None:
    import nibabel

    head = f"{MARK} ".encode()
    for extension in nibabel.load(path).header.extensions:
        content: Any = extension.get_content()
        content = content.encode() if isinstance(content, str) else content
        if content.startswith(head):
            return content[len(head) :].rstrip(b"\0").decode("utf-8")
    return None


def _of_nrrd(path: Path) -> str | None:
    import nrrd

    with path.open("rb") as file:
        return nrrd.read_header(file)[MARK]


def _of_netcdf(path: Path) -> str | None:
    import xarray

    with xarray.open_dataset(path, decode_times=False) as dataset:
        return dataset.attrs[MARK]


TEXTS: dict[str, Callable[[Path], str | None]] = {
    "npz": _of_npz,
    "mat": _of_matlab,
    "vtkhdf": _of_vtkhdf,
    "vti": _of_series,
    "nifti": _of_nifti,
    "nrrd": _of_nrrd,
    "netcdf": _of_netcdf,
}


def _shown(path: Path) -> Recording | None:
    """The recording whose values a sidecar shows."""
    try:
        with h5py.File(path, "r") as file:
            name = file.attrs.get(SOURCE)
    except OSError:
        return None
    if not isinstance(name, str) or Path(name).name != name:
        return None
    source = path.with_name(name)
    if not source.is_file():
        raise FormatError(f"{path}: shows the values of {name}, which is not beside it; convert that file")
    return read_recording(source)


# --- what is what ------------------------------------------------------------------------------------


def _named(mark: Mark, prefix: str = "") -> FieldMap:
    """Fields under a recording's own names, lengths in m."""
    label = {name: f"{prefix}_{name}".strip("_") for name in mark.fields} | ({"velocity": prefix} if prefix else {})
    return FieldMap(
        velocity=(label["velocity"],),
        mask=label.get("mask", ""),
        weight=label.get("weight", ""),
        sigma=(label["sigma"],) if "sigma" in mark.fields else (),
        length_unit="" if prefix else "m",
    )


def _npz(path: Path, mark: Mark) -> tuple[list[Path], FieldMap]:
    axes = "tc" + "zyx"[-mark.grid.dimension :]
    time = tuple(mark.arrays["/time"].tolist())
    return [path], replace(_named(mark), axes=axes, spacing=mark.grid.spacing, origin=mark.grid.origin, time=time)


def _matlab(path: Path, mark: Mark) -> tuple[list[Path], FieldMap]:
    flat = mark.grid.dimension == 2
    spacing = (*mark.grid.spacing, max(mark.grid.spacing)) if flat else mark.grid.spacing
    origin = (*mark.grid.origin, 0.0) if flat else mark.grid.origin
    sigma = tuple(f"sigma_{letter}" for letter in "xyz") if "sigma" in mark.fields else ()
    said = replace(_named(mark), velocity=("u", "v", "w"), sigma=sigma, axes="xyzt", spacing=spacing, origin=origin)
    return [path], replace(said, time=tuple(mark.arrays["/time"].tolist()))


def _vtkhdf(path: Path, mark: Mark) -> tuple[list[Path], FieldMap]:
    return [path], _named(mark)


def _vti(path: Path, mark: Mark) -> tuple[list[Path], FieldMap]:
    return _listed(path), _named(mark)


def _images(path: Path, mark: Mark) -> tuple[list[Path], FieldMap]:
    """NIfTI and NRRD: a file for each field, named after the first."""
    stem, dot, end = path.name.partition(".")
    for ending in (".nii.gz", ".nii", ".seq.nrrd", ".nrrd"):
        if path.name.endswith(ending):
            stem, dot, end = path.name.removesuffix(ending), ".", ending[1:]
            break
    others = [path.with_name(f"{stem}_{name}{dot}{end}") for name in mark.fields if name != "velocity"]
    return [path, *others], _named(mark, stem)


LAYOUTS: dict[str, Callable[[Path, Mark], tuple[list[Path], FieldMap]]] = {
    "npz": _npz,
    "mat": _matlab,
    "vtkhdf": _vtkhdf,
    "vti": _vti,
    "nifti": _images,
    "nrrd": _images,
}


def _listed(series: Path) -> list[Path]:
    """The frames that a ParaView series names, which lie beside it."""
    try:
        names = [str(one["name"]) for one in json.loads(series.read_text(encoding="utf-8"))["files"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [series.with_name(Path(name).name).resolve() for name in names]


# --- the fields --------------------------------------------------------------------------------------


def _fields(files: Sequence[Path], said: FieldMap, mark: Mark) -> dict[str, np.ndarray]:
    """The fields of the mark, indexed as in a recording."""
    first = read_fields(files, said, "")
    found: dict[str, np.ndarray | None] = {name: getattr(first, name) for name in ("velocity", "mask", "weight")}
    found["sigma"] = first.sigma
    for name in mark.fields:
        if name in SCALARS:
            label = said.mask.removesuffix("mask") + name
            found[name] = read_fields(files, replace(said, weight=label, sigma=()), "").weight
        elif name in ("beam", "normal"):
            labels = tuple(f"{name}_{letter}" for letter in "xyz")
            unit = labels if len(said.velocity) > 1 else (said.mask.removesuffix("mask") + name,)
            found[name] = read_fields(files, replace(said, velocity=unit, sigma=()), "").velocity
    return {name: _flat(found[name], first, mark) for name in mark.fields if found.get(name) is not None}  # type: ignore[misc]


def _flat(values: np.ndarray, fields: Fields, mark: Mark) -> np.ndarray:
    """A plane again, where the format made it a layer of a volume."""
    if fields.grid.dimension == mark.grid.dimension:
        return values
    vector = values.ndim == 5
    return values[:, :2, 0] if vector else values[:, 0]


def _of_dataset(path: Path) -> Recording:
    """The recording of a NetCDF file, which holds all of it under the names of `to_xarray`."""
    import xarray

    size = path.stat().st_size
    with xarray.open_dataset(path, decode_times=False) as dataset:
        for name, variable in dataset.variables.items():
            if variable.nbytes > UNWRITTEN + PACKED * size:
                rule = f"claims {variable.nbytes} bytes, but the whole file has {size}; export it again"
                raise FormatError(f"{path}: {name}: {rule}")
        try:
            return from_xarray(dataset)
        except (FormatError, ValueError, TypeError, OSError, RuntimeError) as fault:
            raise FormatError(
                f"{path}: is not what was exported any more ({str(fault)[:200]}); export it again, or say what is what "
                "(--velocity velocity)"
            ) from fault
