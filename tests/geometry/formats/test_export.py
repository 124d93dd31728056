"""Exports, read back by the formats' own readers: values, places, units and times; and converted back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Recording, Wall, read_recording, write_recording
from geometry.formats import (
    FieldMap,
    FormatError,
    PolySeries,
    WallOptions,
    convert,
    export,
    from_xarray,
    write_sidecar,
)

EXTRA = "the extra `formats` is not installed"


def same(one: Recording, other: Recording, *, exact: bool = True) -> None:
    np.testing.assert_allclose(other.grid.origin, one.grid.origin, atol=1e-9)
    np.testing.assert_allclose(other.grid.spacing, one.grid.spacing, rtol=1e-6)
    np.testing.assert_allclose(other.time, one.time, atol=1e-7)
    np.testing.assert_array_equal(other.mask, one.mask)
    if exact:
        np.testing.assert_array_equal(other.velocity, one.velocity)
    np.testing.assert_allclose(other.velocity, one.velocity, atol=1e-6)


def image_at(reader, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and velocities that vtk's reader gives at a time."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader.UpdateInformation()
    reader.UpdateTimeStep(time)
    data = reader.GetOutputDataObject(0)
    points = np.array([data.GetPoint(number) for number in range(data.GetNumberOfPoints())])
    return points, vtk_to_numpy(data.GetPointData().GetArray("velocity"))


@pytest.mark.parametrize("way", ["export", "sidecar"])
def test_vtkhdf_opens_in_vtk_at_every_time(recording: Recording, tmp_path: Path, way: str) -> None:
    pytest.importorskip("vtk", reason=EXTRA)
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    write_recording(tmp_path / "a.h5", recording)
    grid_file, wall_file = (
        export(recording, tmp_path / "a", "vtkhdf") if way == "export" else write_sidecar(tmp_path / "a.h5")
    )
    reader = vtkHDFReader()
    reader.SetFileName(str(grid_file))
    for frame in (2, 0, 1):
        points, velocity = image_at(reader, recording.time[frame])
        np.testing.assert_allclose(points, recording.grid.nodes().numpy(), atol=1e-12)
        np.testing.assert_array_equal(velocity, recording.velocity[frame].reshape(3, -1).T)
    wall = vtkHDFReader()
    wall.SetFileName(str(wall_file))
    for frame in (1, 2, 0):
        points, velocity = image_at(wall, recording.time[frame])
        np.testing.assert_allclose(points, recording.wall.vertices[frame], atol=1e-12)
        np.testing.assert_allclose(velocity, recording.wall.velocity[frame], atol=1e-9)
        mesh = wall.GetOutputDataObject(0)
        faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
        np.testing.assert_array_equal(faces, recording.wall.faces)
        np.testing.assert_array_equal(vtk_to_numpy(mesh.GetCellData().GetArray("region")), recording.wall.region)


def test_a_sidecar_holds_no_copy_of_the_fields(recording: Recording, tmp_path: Path) -> None:
    write_recording(tmp_path / "a.h5", recording)
    sidecar, wall = write_sidecar(tmp_path / "a.h5")
    with h5py.File(wall) as file:
        assert file["VTKHDF/Points"].is_virtual and file["VTKHDF/PointData/velocity"].is_virtual
    with h5py.File(sidecar) as file:
        points = file["VTKHDF/PointData"]
        assert {"velocity", "mask", "weight"} == set(points) and all(node.is_virtual for node in points.values())
        np.testing.assert_array_equal(points["weight"][()], recording.weight)
    (tmp_path / "elsewhere").mkdir()
    for name in ("a.h5", "a.vtkhdf", "a_wall.vtkhdf"):
        (tmp_path / name).rename(tmp_path / "elsewhere" / name)
    with h5py.File(tmp_path / "elsewhere" / "a.vtkhdf") as file:  # all moved: the links are relative
        assert file["VTKHDF/PointData/velocity"][()].any()
    with h5py.File(tmp_path / "elsewhere" / "a_wall.vtkhdf") as file:
        np.testing.assert_array_equal(file["VTKHDF/Points"][()], recording.wall.vertices.reshape(-1, 3))


def test_a_sidecar_shows_a_wall_at_rest_and_a_wall_without_velocities(recording: Recording, tmp_path: Path) -> None:
    pytest.importorskip("vtk", reason=EXTRA)
    from vtkmodules.vtkIOHDF import vtkHDFReader

    moving = Wall(recording.wall.vertices, recording.wall.faces, recording.wall.region)
    still = Wall(recording.wall.vertices[0], recording.wall.faces, recording.wall.region)
    rate = np.gradient(moving.vertices, recording.time, axis=0)
    for name, wall, speed in (("moving", moving, rate), ("still", still, np.zeros_like(rate))):
        write_recording(tmp_path / f"{name}.h5", replace(recording, wall=wall))
        reader = vtkHDFReader()
        reader.SetFileName(str(write_sidecar(tmp_path / f"{name}.h5")[1]))
        for frame in (2, 0, 1):
            points, velocity = image_at(reader, recording.time[frame])
            np.testing.assert_allclose(points, wall.at(frame).vertices, atol=1e-12)
            np.testing.assert_allclose(velocity, speed[frame], atol=1e-7)


def test_vtkhdf_is_converted_back(recording: Recording, tmp_path: Path) -> None:
    path, _ = export(recording, tmp_path / "a", "vtkhdf")
    result = convert([path], FieldMap(length_unit="m", mask="mask", weight="weight"))
    same(recording, result.recording)
    np.testing.assert_array_equal(result.recording.weight, recording.weight)


@pytest.mark.parametrize("way", ["export", "sidecar"])
def test_a_single_frame_opens_in_vtk(recording: Recording, tmp_path: Path, way: str) -> None:
    """VTK expects no axis of times where there is one time."""
    pytest.importorskip("vtk", reason=EXTRA)
    from vtkmodules.vtkIOHDF import vtkHDFReader

    single = recording.select([1])
    write_recording(tmp_path / "s.h5", single)
    files = export(single, tmp_path / "t", "vtkhdf") if way == "export" else write_sidecar(tmp_path / "s.h5")
    for file, expected in zip(files, (single.velocity[0].reshape(3, -1).T, single.wall.velocity[0]), strict=True):
        reader = vtkHDFReader()
        reader.SetFileName(str(file))
        reader.Update()
        _, velocity = image_at(reader, single.time[0])
        np.testing.assert_allclose(velocity, expected, atol=1e-9)
    if way == "export":
        same(single, convert(files[:1], FieldMap(length_unit="m", mask="mask")).recording)


def test_a_plane_recording_opens_in_vtk(box_recording: Callable[..., Recording], tmp_path: Path) -> None:
    pytest.importorskip("vtk", reason=EXTRA)
    from vtkmodules.vtkIOHDF import vtkHDFReader

    plane = box_recording(lambda points, time: points * [1, -1] + time, dimension=2)
    write_recording(tmp_path / "p.h5", plane)
    for files in (export(plane, tmp_path / "q", "vtkhdf"), write_sidecar(tmp_path / "p.h5")):
        reader = vtkHDFReader()
        reader.SetFileName(str(files[0]))
        points, velocity = image_at(reader, plane.time[1])
        np.testing.assert_allclose(points[:, :2], plane.grid.nodes().numpy(), atol=1e-12)
        np.testing.assert_array_equal(velocity, np.c_[plane.velocity[1].reshape(2, -1).T, np.zeros(len(points))])
    result = convert([tmp_path / "q.vtkhdf"], FieldMap(length_unit="m", mask="mask"))
    same(plane, result.recording)


def test_particles_of_changing_number_open_in_vtk(tmp_path: Path) -> None:
    pytest.importorskip("vtk", reason=EXTRA)
    from vtkmodules.vtkIOHDF import vtkHDFReader

    draw = np.random.default_rng(0)
    states = {0.0: draw.random((7, 3)), 0.5: draw.random((4, 3)), 1.0: draw.random((9, 3))}
    with PolySeries(tmp_path / "run.vtkhdf") as series:
        for time, points in states.items():
            series.append(time, points, point_data={"velocity": 2 * points, "member": np.arange(len(points))})
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "run.vtkhdf"))
    for time, expected in reversed(states.items()):
        points, velocity = image_at(reader, time)
        np.testing.assert_allclose(points, expected)
        np.testing.assert_allclose(velocity, 2 * expected)
        assert reader.GetOutputDataObject(0).GetNumberOfVerts() == len(expected)


def test_vti_series_are_converted_back(recording: Recording, tmp_path: Path) -> None:
    pytest.importorskip("vtk", reason=EXTRA)
    files = export(recording, tmp_path / "a", "vti")
    frames = sorted(tmp_path.glob("a_0*.vti"))
    assert files[0].name == "a.vti.series" and len(frames) == 3
    walls = tuple(map(str, sorted(tmp_path.glob("a_wall_*.vtp"))))
    result = convert(frames, FieldMap(length_unit="m", mask="mask"), wall=WallOptions(walls))
    same(recording, result.recording)
    np.testing.assert_allclose(result.recording.wall.vertices, recording.wall.vertices, atol=1e-9)
    np.testing.assert_array_equal(result.recording.wall.region, recording.wall.region)


def test_nifti_as_nibabel_sees_it(recording: Recording, tmp_path: Path) -> None:
    nibabel = pytest.importorskip("nibabel", reason=EXTRA)
    files = export(recording, tmp_path / "a", "nifti")
    assert [file.name for file in files] == ["a.nii.gz", "a_mask.nii.gz", "a_weight.nii.gz"]
    image = nibabel.load(files[0])
    assert image.shape == (9, 7, 5, 3, 3) and image.header.get_xyzt_units() == ("mm", "sec")
    assert image.header["pixdim"][4] == pytest.approx(0.02)
    place = nibabel.affines.apply_affine(image.affine, [2, 3, 1])
    np.testing.assert_allclose(place, [-1.0, -3.6, 2.5], atol=1e-5)  # RAS, mm, of the node at (1, 3.6, 2.5) in LPS
    np.testing.assert_allclose(image.dataobj[2, 3, 1, 0], recording.velocity[0, :, 1, 3, 2] * [-1, -1, 1])
    result = convert(files[:2], FieldMap(velocity=("a",), mask="a_mask"))
    same(recording, result.recording)


def test_uneven_frames_are_no_nifti(recording: Recording, tmp_path: Path) -> None:
    pytest.importorskip("nibabel", reason=EXTRA)
    with pytest.raises(FormatError, match="not evenly spaced in time"):
        export(replace(recording, time=np.array([0.1, 0.12, 0.2])), tmp_path / "a", "nifti")


def test_nrrd_sequences_as_pynrrd_sees_them(recording: Recording, tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd", reason=EXTRA)
    files = export(recording, tmp_path / "a", "nrrd")
    values, header = nrrd.read(str(files[0]))
    assert values.shape == (3, 3, 9, 7, 5) and header["space"] == "left-posterior-superior"
    np.testing.assert_array_equal(values, recording.velocity.transpose(0, 1, 4, 3, 2))
    np.testing.assert_allclose(header["space origin"], [-1, 0, 1])
    result = convert(files[:2], FieldMap(velocity=("a",), mask="a_mask"))
    same(recording, result.recording)


def test_mat_as_scipy_sees_it(recording: Recording, tmp_path: Path) -> None:
    from scipy.io import loadmat

    (path,) = export(recording, tmp_path / "a", "mat")
    content = loadmat(path, simplify_cells=True)
    np.testing.assert_array_equal(content["v"], recording.velocity[:, 1].transpose(3, 2, 1, 0))
    np.testing.assert_allclose(content["y"], 0.0012 * np.arange(7))
    np.testing.assert_array_equal(content["wall"]["vertices"][:, :, 2], recording.wall.vertices[2])
    assert content["wall"]["faces"].min() == 1
    said = FieldMap(velocity=("u", "v", "w"), mask="mask", time="t", length_unit="m", spacing=recording.grid.spacing)
    result = convert([path], replace(said, origin=recording.grid.origin))
    same(recording, result.recording)


def test_netcdf_as_xarray_sees_it(recording: Recording, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason=EXTRA)
    pytest.importorskip("netCDF4", reason=EXTRA)
    (path,) = export(recording, tmp_path / "a", "netcdf")
    with xarray.open_dataset(path, decode_times=False) as dataset:
        assert dataset.velocity.attrs["units"] == "m s-1" and dataset.x.attrs["units"] == "m"
        picked = dataset.velocity.sel(component="z").isel(time=1, x=4, y=3, z=2)
        assert float(picked) == recording.velocity[1, 2, 2, 3, 4]
    result = convert([path], FieldMap(velocity=("velocity",), mask="mask"))
    same(recording, result.recording)


def test_npz_is_converted_back(recording: Recording, tmp_path: Path) -> None:
    (path,) = export(recording, tmp_path / "a", "npz")
    said = FieldMap(velocity=("velocity",), mask="mask", weight="weight", time="time", spacing="spacing")
    result = convert([path], replace(said, origin=recording.grid.origin, length_unit="m", axes="tczyx"))
    same(recording, result.recording)
    with pytest.raises(FormatError, match="velocity: what do the axes of its shape .* mean"):
        convert([path], said)  # 3 frames of 3 components: which axis is which, nobody can tell


def test_exports_that_cannot_be_are_refused(recording: Recording, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="there is no format 'avi'; known are vtkhdf"):
        export(recording, tmp_path / "a", "avi")
    with pytest.raises(FileNotFoundError, match="there is no directory"):
        export(recording, tmp_path / "nowhere" / "a", "npz")


def test_xarray_round_trip_and_engine(recording: Recording, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason=EXTRA)
    from geometry.formats import to_xarray
    from geometry.formats.xarray_engine import RecordingEntrypoint

    back = from_xarray(to_xarray(recording).transpose(...))
    assert back.grid == recording.grid
    for name, values in recording.arrays().items():
        np.testing.assert_array_equal(back.arrays()[name], values)
    write_recording(tmp_path / "a.h5", recording)
    dataset = xarray.open_dataset(tmp_path / "a.h5", engine=RecordingEntrypoint)
    same(read_recording(tmp_path / "a.h5"), from_xarray(dataset))
    assert RecordingEntrypoint().guess_can_open(tmp_path / "a.h5")
    assert not RecordingEntrypoint().guess_can_open(tmp_path / "b.h5")
    with pytest.raises(FormatError, match="has no mask"):
        from_xarray(dataset.drop_vars("mask"))
