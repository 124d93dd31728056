"""Files of some hundred bytes that declare a million million values: refused at once, and nothing is made of them."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import SurfaceError, read_surface
from geometry.formats import FieldMap, FormatError, convert

HUGE = 10_000  # nodes along each axis
UVW = FieldMap(velocity=("u", "v", "w"), spacing=(1.0,), length_unit="mm", interval=0.01)
IMAGE = FieldMap(length_unit="mm", interval=0.01)
EXTRA = "the extra `formats` is not installed"


def _hdf5(path: Path) -> FieldMap:
    with h5py.File(path, "w") as file:
        for name in "uvw":
            file.create_dataset(name, (1, HUGE, HUGE, HUGE), "f4", chunks=(1, 10, 10, 10))
    return UVW


def _vtkhdf(path: Path) -> FieldMap:
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        extent = np.array([0, HUGE - 1] * 3)
        root.attrs.update(Type=np.bytes_("ImageData"), WholeExtent=extent, Origin=np.zeros(3), Spacing=np.ones(3))
        root.create_dataset("PointData/velocity", (HUGE, HUGE, HUGE, 3), "f4", chunks=(10, 10, 10, 3))
    return IMAGE


def _matlab(path: Path, *, packed: bool) -> FieldMap:
    def part(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    elements = b""
    for name in "uvw":
        head = part(6, struct.pack("<II", 6, 0)) + part(5, struct.pack("<iii", HUGE, HUGE, HUGE))
        matrix = part(14, head + part(1, name.encode()) + struct.pack("<II", 9, 64) + b"\0" * 64)
        unpadded = zlib.compress(matrix)
        elements += struct.pack("<II", 15, len(unpadded)) + unpadded if packed else matrix
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM" + elements)
    return UVW


def _npz(path: Path) -> FieldMap:
    with zipfile.ZipFile(path, "w") as archive:
        for name in "uvw":
            head = io.BytesIO()
            shape = {"shape": (HUGE, HUGE, HUGE), "fortran_order": False, "descr": "<f4"}
            np.lib.format.write_array_header_1_0(head, shape)
            archive.writestr(f"{name}.npy", head.getvalue())
    return UVW


def _nifti(path: Path) -> FieldMap:
    nibabel = pytest.importorskip("nibabel", reason=EXTRA)
    header = nibabel.Nifti1Header()
    header.set_data_shape((HUGE, HUGE, HUGE, 1, 3))
    header.set_data_dtype(np.float32)
    header["magic"], header["vox_offset"] = b"n+1", 352
    path.write_bytes(header.binaryblock + b"\0" * 100)
    return IMAGE


def _nrrd(path: Path, encoding: str) -> FieldMap:
    pytest.importorskip("nrrd", reason=EXTRA)
    lines = ["NRRD0004", "type: float", "dimension: 4", f"sizes: 3 {HUGE} {HUGE} {HUGE}", "endian: little"]
    lines += ["kinds: vector domain domain domain", f"encoding: {encoding}", "space: left-posterior-superior"]
    lines += ["space directions: none (1,0,0) (0,1,0) (0,0,1)", "space origin: (0,0,0)", "", ""]
    data = zlib.compress(b"\0" * 64) if encoding == "gzip" else b"\0" * 64
    path.write_bytes("\n".join(lines).encode() + data)
    return IMAGE


def _metaimage(path: Path, *, packed: bool) -> FieldMap:
    pytest.importorskip("SimpleITK", reason=EXTRA)
    text = f"ObjectType = Image\nNDims = 3\nBinaryData = True\nCompressedData = {packed}\nElementSpacing = 1 1 1\n"
    text += f"DimSize = {HUGE} {HUGE} {HUGE}\nElementNumberOfChannels = 3\nElementType = MET_FLOAT\n"
    path.write_bytes((text + "ElementDataFile = LOCAL\n").encode() + zlib.compress(b"\0" * 64))
    return IMAGE


def _vti(path: Path) -> FieldMap:
    pytest.importorskip("vtkmodules", reason=EXTRA)
    extent = f"0 {HUGE - 1} 0 {HUGE - 1} 0 {HUGE - 1}"
    path.write_text(
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">'
        f'<ImageData WholeExtent="{extent}" Origin="0 0 0" Spacing="1 1 1"><Piece Extent="{extent}"><PointData>'
        '<DataArray type="Float32" Name="velocity" NumberOfComponents="3" format="appended" offset="0"/></PointData>'
        '</Piece></ImageData><AppendedData encoding="raw">_'
        "\0\0\0\0\0\0\0\0</AppendedData></VTKFile>"
    )
    return IMAGE


def _legacy(path: Path) -> FieldMap:
    lines = ["# vtk DataFile Version 3.0", "made up", "BINARY", "DATASET STRUCTURED_POINTS"]
    lines += [f"DIMENSIONS {HUGE} {HUGE} {HUGE}", "ORIGIN 0 0 0", "SPACING 1 1 1", f"POINT_DATA {HUGE**3}"]
    path.write_bytes("\n".join([*lines, "VECTORS velocity float", ""]).encode() + b"\0" * 64)
    return IMAGE


def _netcdf(path: Path) -> FieldMap:
    netcdf = pytest.importorskip("netCDF4", reason=EXTRA)
    with netcdf.Dataset(path, "w") as file:
        for axis in "zyx":
            file.createDimension(axis, HUGE)
        for name in "uvw":
            file.createVariable(name, "f4", ("z", "y", "x"), zlib=True, chunksizes=(10, 10, 10))
    return UVW


def _zarr(path: Path) -> FieldMap:
    zarr = pytest.importorskip("zarr", reason=EXTRA)
    group = zarr.open_group(path, mode="w", zarr_format=2)
    for name in "uvw":
        array = group.create_array(name, shape=(HUGE,) * 3, chunks=(10, 10, 10), dtype="f4")
        array.attrs["_ARRAY_DIMENSIONS"] = ["z", "y", "x"]
    return UVW


TINY: dict[str, Callable[[Path], FieldMap]] = {
    "a.h5": _hdf5,
    "a.vtkhdf": _vtkhdf,
    "a.mat": lambda path: _matlab(path, packed=False),
    "packed.mat": lambda path: _matlab(path, packed=True),
    "hdf5.mat": _hdf5,
    "a.npz": _npz,
    "a.nii": _nifti,
    "a.nrrd": lambda path: _nrrd(path, "raw"),
    "packed.nrrd": lambda path: _nrrd(path, "gzip"),
    "text.nrrd": lambda path: _nrrd(path, "ascii"),
    "a.mha": lambda path: _metaimage(path, packed=False),
    "packed.mha": lambda path: _metaimage(path, packed=True),
    "a.vti": _vti,
    "a.vtk": _legacy,
    "a.nc": _netcdf,
    "a.zarr": _zarr,
}


@pytest.mark.parametrize("nodes", [10_000, 500])
@pytest.mark.parametrize("name", TINY)
def test_what_no_such_file_can_hold_is_refused_unread(
    tmp_path: Path, name: str, nodes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{__name__}.HUGE", nodes)
    said = TINY[name](tmp_path / name)
    with pytest.raises(FormatError, match=rf"{name}: .*(claims|is no readable)"):
        convert([tmp_path / name], said)
    tracemalloc.start()  # now that the readers' modules are loaded
    with pytest.raises(FormatError):
        convert([tmp_path / name], said)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**23


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_surfaces_that_claim_more_than_they_hold_are_refused(tmp_path: Path, form: str) -> None:
    head = ["ply", f"format {form} 1.0", f"element vertex {HUGE**3}", *(f"property float {axis}" for axis in "xyz")]
    head += [f"element face {HUGE**3}", "property list uchar int vertex_indices", "end_header", "0 0 0"]
    (tmp_path / "a.ply").write_text("\n".join(head))
    (tmp_path / "a.stl").write_bytes(b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50)
    for name in ("a.ply", "a.stl"):
        with pytest.raises(SurfaceError, match=name):
            read_surface(tmp_path / name)
