"""The formats that velocity is read from: a new one is a file in `readers` and a line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py

from .field_map import FieldMap
from .readers.hdf5 import open_hdf5
from .readers.matlab import open_matlab
from .readers.metaimage import open_metaimage
from .readers.nifti import open_nifti
from .readers.npz import open_npz
from .readers.nrrd_file import open_nrrd
from .readers.piv_text import open_piv
from .readers.tracks import open_tracks
from .readers.vtk_image import open_vtk_image, open_vtkhdf
from .readers.xarray_file import open_xarray
from .source import FormatError, Source, understood


@dataclass(frozen=True)
class Format:
    """A format: what it is called, the ends of its files' names, the package that reads it, and how."""

    name: str
    suffixes: tuple[str, ...]
    package: str
    open: Callable[[Path, FieldMap], Source]


def _plain(reader: Callable[[Path], Source]) -> Callable[[Path, FieldMap], Source]:
    return lambda path, _: reader(path)


FORMATS: tuple[Format, ...] = (
    Format("vtkhdf", (".vtkhdf",), "h5py", _plain(open_vtkhdf)),
    Format("hdf5", (".h5", ".hdf5", ".hdf", ".he5"), "h5py", _plain(open_hdf5)),
    Format("matlab", (".mat",), "scipy, h5py", _plain(open_matlab)),
    Format("npz", (".npz",), "numpy", _plain(open_npz)),
    Format("vtk", (".vti", ".vtk"), "vtk", _plain(open_vtk_image)),
    Format("nifti", (".nii", ".nii.gz"), "nibabel", _plain(open_nifti)),
    Format("nrrd", (".nrrd", ".nhdr"), "pynrrd", _plain(open_nrrd)),
    Format("metaimage", (".mha", ".mhd"), "SimpleITK", _plain(open_metaimage)),
    Format("xarray", (".nc", ".nc4", ".zarr"), "xarray", _plain(open_xarray)),
    Format("piv", (".txt", ".dat", ".vec"), "numpy", _plain(open_piv)),
    Format("tracks", (".trk", ".csv"), "numpy", open_tracks),
)


def open_source(path: Path, said: FieldMap, name: str = "") -> Source:
    """What a file holds, by the format of that name or, without one, by the end of the file's own name.

    Raises:
        FileNotFoundError: there is no such file.
        FormatError: no format fits, its package is missing, or the file is none of that format.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    known = {one.name: one for one in FORMATS}
    if name and name not in known:
        raise FormatError(f"{path}: there is no format {name!r}; known are {', '.join(known)}")
    with understood(path):
        fitting = known.get(name) or next((one for one in FORMATS if path.name.lower().endswith(one.suffixes)), None)
        if fitting is None:
            raise FormatError(f"{path}: which format is it? Say it (--format {'|'.join(known)})")
        if not name and fitting.name == "hdf5" and _is_vtkhdf(path):
            fitting = known["vtkhdf"]
        return fitting.open(path, said)


def _is_vtkhdf(path: Path) -> bool:
    if not h5py.is_hdf5(path):
        return False
    with h5py.File(path, "r") as file:
        return "VTKHDF" in file
