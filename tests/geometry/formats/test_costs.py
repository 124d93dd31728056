"""What reading costs: memory beside the result's own, and how often a file is gone through."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Grid, Recording, Wall, box, write_surface
from geometry.formats import FieldMap, FormatError, WallOptions, convert, export, to_xarray
from geometry.formats.axis_order import in_best_order
from geometry.formats.series import read_fields
from geometry.formats.source import Source

MISSING = "the extra `formats` is not installed"
FRAMES, NODES = 40, 24
GRID = Grid((0.0, 0.0, 0.0), (2e-3, 2e-3, 2e-3), (NODES,) * 3)
PLACED = {"spacing": GRID.spacing, "origin": GRID.origin, "length_unit": "m"}
UVW = FieldMap(velocity=("u", "v", "w"), mask="mask", time="t", axes="xyzt", **PLACED)
ARRAYS = FieldMap(velocity=("velocity",), mask="mask", time="time", axes="tczyx", **PLACED)
IMAGE = FieldMap(mask="mask", interval=0.02, length_unit="m")


@pytest.fixture(name="recording", scope="module")
def _recording() -> Recording:
    x, y, z = GRID.nodes().numpy().T.reshape(3, *GRID.shape)
    flow = np.stack([10 * y, -10 * x, 0 * z]).astype(np.float32)
    velocity = np.stack([flow * (1 + 0.01 * frame) for frame in range(FRAMES)])
    walls = box((0, 0, 0), GRID.upper, 0.012)
    wall = Wall(walls.vertices, walls.faces, walls.region)
    return Recording(0.02 * np.arange(FRAMES), GRID, velocity, np.ones(GRID.shape, bool), wall, 1060.0, 0.004)


def _vtk_files(recording: Recording, folder: Path) -> list[Path]:
    """A legacy file of each frame, as vtk writes it in binary."""
    vtk = pytest.importorskip("vtkmodules.vtkIOLegacy", reason=MISSING)
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkStructuredPoints

    files = []
    for frame in range(recording.frames):
        image = vtkStructuredPoints()
        image.SetDimensions(*reversed(GRID.shape))
        image.SetSpacing(*GRID.spacing)
        image.SetOrigin(*GRID.origin)
        for name, values in (
            ("velocity", np.moveaxis(recording.velocity[frame], 0, -1).reshape(-1, 3)),
            ("mask", recording.mask[frame].astype(np.int16).ravel()),
        ):
            array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
            array.SetName(name)
            image.GetPointData().AddArray(array)
        writer = vtk.vtkStructuredPointsWriter()
        files.append(folder / f"frame_{frame:02d}.vtk")
        writer.SetFileName(str(files[-1]))
        writer.SetInputData(image)
        writer.SetFileTypeToBinary()
        writer.Write()
    return files


def _metaimage(recording: Recording, folder: Path, *, packed: bool) -> list[Path]:
    """A file of each frame, as ITK writes it."""
    sitk = pytest.importorskip("SimpleITK", reason=MISSING)
    files = []
    for frame in range(recording.frames):
        image = sitk.GetImageFromArray(np.moveaxis(recording.velocity[frame], 0, -1), isVector=True)
        image.SetSpacing([1e3 * step for step in GRID.spacing])
        files.append(folder / f"v_{frame:02d}.mha")
        sitk.WriteImage(image, str(files[-1]), packed)
    return files


def _nrrd(recording: Recording, folder: Path) -> list[Path]:
    """One plain file as pynrrd writes it, times last."""
    nrrd = pytest.importorskip("nrrd", reason=MISSING)
    nothing = np.full(3, np.nan)
    header = {
        "space": "left-posterior-superior",
        "kinds": ["vector", "domain", "domain", "domain", "list"],
        "space directions": np.array([nothing, *np.diag(1e3 * np.array(GRID.spacing)), nothing]),
        "space origin": np.zeros(3),
        "encoding": "raw",
    }
    nrrd.write(str(folder / "v.nrrd"), recording.velocity.transpose(1, 4, 3, 2, 0), header, index_order="F")
    return [folder / "v.nrrd"]


def _hdf5(recording: Recording, folder: Path, *, matlab: bool = False) -> list[Path]:
    """Plain datasets; MATLAB 7.3 has a block of its own before them, and its axes are called the other way."""
    path = folder / ("v.mat" if matlab else "v.h5")
    with h5py.File(path, "w", userblock_size=512 if matlab else 0) as file:
        for component, name in enumerate("uvw"):
            file.create_dataset(name, data=recording.velocity[:, component], compression="gzip")
        file["mask"] = recording.mask.astype(np.uint8)
        file["t"] = recording.time
    return [path]


def _zarr(recording: Recording, folder: Path) -> list[Path]:
    pytest.importorskip("zarr", reason=MISSING)
    pytest.importorskip("xarray", reason=MISSING)
    dataset = to_xarray(recording)[["velocity", "mask"]]
    pieces = {name: {"chunks": (1, *dataset[name].shape[1:])} for name in ("velocity", "mask")}
    dataset.drop_vars("component").to_zarr(folder / "v.zarr", encoding=pieces, consolidated=False)
    return [folder / "v.zarr"]


def _exported(name: str, package: str) -> Callable[[Recording, Path], list[Path]]:
    def write(recording: Recording, folder: Path) -> list[Path]:
        if package:
            pytest.importorskip(package, reason=MISSING)
        files = export(recording, folder / "a", name)
        return sorted(folder.glob("a_0*.vti")) if name == "vti" else files[:1]

    return write


KINDS: dict[str, tuple[Callable[[Recording, Path], list[Path]], FieldMap]] = {
    "vtkhdf": (_exported("vtkhdf", ""), IMAGE),
    "vti": (_exported("vti", "vtk"), IMAGE),
    "nifti": (_exported("nifti", "nibabel"), FieldMap(velocity=("a",))),
    "netcdf": (_exported("netcdf", "netCDF4"), FieldMap(velocity=("velocity",), mask="mask")),
    "npz": (_exported("npz", ""), ARRAYS),
    "nrrd sequence": (_exported("nrrd", "nrrd"), FieldMap()),
    "matlab 5": (_exported("mat", ""), UVW),
    "nrrd": (_nrrd, FieldMap(interval=0.02)),
    "metaimage": (partial(_metaimage, packed=False), FieldMap(interval=0.02)),
    "metaimage packed": (partial(_metaimage, packed=True), FieldMap(interval=0.02)),
    "legacy vtk": (_vtk_files, IMAGE),
    "hdf5": (_hdf5, replace(UVW, axes="tzyx")),
    "matlab 7.3": (partial(_hdf5, matlab=True), UVW),
    "zarr": (_zarr, FieldMap(velocity=("velocity",), mask="mask")),
}


def _within_limit(recording: Recording, folder: Path, name: str) -> None:
    write, said = KINDS[name]
    inputs = write(recording, folder)
    write_surface(folder / "wall.stl", recording.wall.at(0))
    wall = WallOptions((str(folder / "wall.stl"),), unit="m")
    convert(inputs, said, wall=wall)  # what modules keep for good is not the reading's
    tracemalloc.start()
    found = convert(inputs, said, wall=wall).recording
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(found.velocity, recording.velocity, atol=1e-6)
    result = sum(values.nbytes for values in found.arrays().values())
    assert peak < 1.5 * result, f"{peak / result:.3g}"


@pytest.mark.parametrize("name", KINDS)
def test_reading_takes_half_the_result_more_at_most(recording: Recording, tmp_path: Path, name: str) -> None:
    _within_limit(recording, tmp_path, name)


def _plane_texts(folder: Path, files: int, lines: int) -> list[Path]:
    x, y = np.meshgrid(0.5 * np.arange(lines), 0.5 * np.arange(lines))
    for number in range(files):
        rows = np.c_[x.ravel(), y.ravel(), 0.1 * x.ravel() + number, 0.2 * y.ravel()]
        np.savetxt(folder / f"B{number:02d}.txt", rows, fmt="%.6g")
    return sorted(folder.glob("B*.txt"))


@pytest.mark.parametrize(("files", "lines"), [(8, 60), (1, 200)])
def test_reading_vectors_as_text_takes_half_the_result_more(tmp_path: Path, files: int, lines: int) -> None:
    inputs = _plane_texts(tmp_path, files, lines)
    said = FieldMap(length_unit="mm", velocity_unit="m/s", interval=0.01)
    tracemalloc.start()
    fields = read_fields(inputs, said, "piv")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(fields.velocity[-1, :, 3, 5], [0.25 + files - 1, 0.3], rtol=1e-6)
    result = fields.velocity.nbytes + fields.mask.nbytes
    lines_at_a_time = 2**20  # bytes that numbers in a few thousand lines of text take
    assert peak < 1.5 * result + lines_at_a_time, f"{peak / result:.3g}"


class Counting:
    """An array that counts how often each of its values was asked for."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.shape, self.dtype = values, values.shape, values.dtype
        self.read = np.zeros(values.shape, int)

    def __getitem__(self, index: tuple) -> np.ndarray:
        self.read[index] += 1
        return self.values[index]


def test_the_order_of_axes_takes_one_reading() -> None:
    x, y, z = np.meshgrid(*(np.arange(n) * 1.0 for n in (9, 8, 7)), indexing="ij")
    flow = {"u": 20 * x - 9 * y, "v": 10 * x + 10 * y, "w": -30 * z + 5 * x}  # no divergence, arrays [x, y, z]
    arrays = {name: Counting(1e-3 * values[None]) for name, values in flow.items()}
    said = FieldMap(velocity=("u", "v", "w"), spacing=(1.0,), length_unit="mm", axes="auto")
    fields, axes = in_best_order(Source("a file", arrays), said)
    assert axes == "xyz" and all((one.read == 1).all() for one in arrays.values())
    np.testing.assert_allclose(fields.velocity[0, :, 3, 2, 4], 1e-3 * np.array([20 * 4 - 18, 60, -70]), rtol=1e-6)
    with pytest.raises(FormatError, match="says itself how its axes lie"):
        in_best_order(Source("a file", arrays, affine=np.eye(4)), said)


def test_arrays_that_no_file_of_that_size_holds_are_refused_unread(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        for name in "uvw":
            file.create_dataset(name, (100, 256, 256, 256), "f4", chunks=(1, 16, 16, 16))
    said = FieldMap(velocity=("u", "v", "w"), spacing=(1.0,), length_unit="mm", interval=0.01)
    tracemalloc.start()
    with pytest.raises(FormatError, match=r"empty\.h5: u: claims .* but the whole file has"):
        convert([tmp_path / "empty.h5"], said)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**22


def test_files_of_a_series_are_alike(recording: Recording, tmp_path: Path) -> None:
    one, two = recording.select([0]), recording.select([1, 2])
    files = [export(part, tmp_path / name, "npz")[0] for part, name in ((one, "one"), (two, "two"))]
    with pytest.raises(FormatError, match=r"two\.npz: holds other frames"):
        read_fields(files, ARRAYS, "")
    untimed = replace(ARRAYS, time="", interval=0.5)
    np.testing.assert_allclose(read_fields([files[1]] * 2, untimed, "").time, [0, 0.5, 1.0, 1.5])
    same = [export(recording.select([frame]), tmp_path / f"f{frame}", "npz")[0] for frame in range(3)]
    fields = read_fields(same, ARRAYS, "")
    np.testing.assert_array_equal(fields.velocity, recording.velocity[:3])
    np.testing.assert_allclose(fields.time, [0, 0.02, 0.04])
