"""What reading costs: memory beside the result's own, and how often a file is gone through."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Grid, Recording, Wall, box, write_surface
from geometry.formats import FieldMap, FormatError, WallOptions, convert, export
from geometry.formats.axis_order import in_best_order
from geometry.formats.series import read_fields
from geometry.formats.source import Source

EXTRA = {"netcdf": "netCDF4", "nifti": "nibabel", "vti": "vtk"}
FRAMES, NODES = 24, 24
GRID = Grid((0.0, 0.0, 0.0), (2e-3, 2e-3, 2e-3), (NODES,) * 3)
PLACED = {"spacing": GRID.spacing, "origin": GRID.origin, "length_unit": "m"}
SAID = {
    "vtkhdf": FieldMap(length_unit="m", mask="mask"),
    "vti": FieldMap(length_unit="m", mask="mask"),
    "nifti": FieldMap(velocity=("a",)),
    "netcdf": FieldMap(velocity=("velocity",), mask="mask"),
    "npz": FieldMap(velocity=("velocity",), mask="mask", time="time", axes="tczyx", **PLACED),
}


@pytest.fixture(name="recording", scope="module")
def _recording() -> Recording:
    x, y, z = GRID.nodes().numpy().T.reshape(3, *GRID.shape)
    flow = np.stack([10 * y, -10 * x, 0 * z]).astype(np.float32)
    velocity = np.stack([flow * (1 + 0.01 * frame) for frame in range(FRAMES)])
    walls = box((0, 0, 0), GRID.upper, 0.012)
    wall = Wall(walls.vertices, walls.faces, walls.region)
    return Recording(0.02 * np.arange(FRAMES), GRID, velocity, np.ones(GRID.shape, bool), wall, 1060.0, 0.004)


@pytest.mark.parametrize("name", SAID)
def test_reading_takes_half_the_result_more_at_most(recording: Recording, tmp_path: Path, name: str) -> None:
    if name in EXTRA:
        pytest.importorskip(EXTRA[name], reason="the extra `formats` is not installed")
    files = export(recording, tmp_path / "a", name)
    inputs = sorted(tmp_path.glob("a_0*.vti")) if name == "vti" else files[:1]
    write_surface(tmp_path / "wall.stl", recording.wall.at(0))
    wall = WallOptions((str(tmp_path / "wall.stl"),), unit="m")
    convert(inputs, SAID[name], wall=wall)  # what modules keep for good is not the reading's
    tracemalloc.start()
    found = convert(inputs, SAID[name], wall=wall).recording
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(found.velocity, recording.velocity, atol=1e-6)
    assert peak < 1.5 * sum(values.nbytes for values in found.arrays().values())


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
        read_fields(files, SAID["npz"], "")
    untimed = replace(SAID["npz"], time="", interval=0.5)
    np.testing.assert_allclose(read_fields([files[1]] * 2, untimed, "").time, [0, 0.5, 1.0, 1.5])
    same = [export(recording.select([frame]), tmp_path / f"f{frame}", "npz")[0] for frame in range(3)]
    fields = read_fields(same, SAID["npz"], "")
    np.testing.assert_array_equal(fields.velocity, recording.velocity[:3])
    np.testing.assert_allclose(fields.time, [0, 0.02, 0.04])
