"""VTK images: VTI and legacy .vtk by the vtk package, VTKHDF image data by h5py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from geometry.formats.source import FormatError, Source, diagonal, missing_extra
from geometry.surfaces.readers.quiet_vtk import quiet_vtk

from .hdf5 import datasets, text
from .streamed import Streamed
from .vtk_legacy import read_legacy

SLABS = 16  # parts of an image that are read one at a time


class Slabs:
    """A point array of a VTI file, indexed [z, y, x] or [z, y, x, c], of which vtk reads the layers asked for."""

    def __init__(self, reader: Any, name: str, shape: tuple[int, ...], first: tuple[int, ...]) -> None:
        self._reader, self._name, self._first = reader, name, first
        self.shape, self.dtype = shape, np.dtype(np.float64)
        self.chunks = (-(-shape[0] // SLABS), *shape[1:])

    def __getitem__(self, index: tuple) -> np.ndarray:
        from vtkmodules.util.numpy_support import vtk_to_numpy

        begin, end, _ = index[0].indices(self.shape[0]) if index != (...,) else (0, self.shape[0], 1)
        low, (ny, nx) = self._first, self.shape[1:3]
        selection = self._reader.GetPointDataArraySelection()
        selection.DisableAllArrays()
        selection.EnableArray(self._name)
        extent = (low[0], low[0] + nx - 1, low[1], low[1] + ny - 1, low[2] + begin, low[2] + end - 1)
        with quiet_vtk():
            self._reader.UpdateExtent(extent)
        values = vtk_to_numpy(self._reader.GetOutput().GetPointData().GetArray(self._name))
        values = values.reshape(end - begin, *self.shape[1:])
        return values.copy() if index == (...,) else values[(slice(None), *index[1:])].copy()


def open_vtk_image(path: Path) -> Source:
    """The point arrays of a VTI file or of legacy structured points, with its direction matrix and time."""
    if path.suffix.lower() == ".vtk":
        legacy = read_legacy(path)
        if legacy is not None:
            time = None if legacy.time is None else np.array([legacy.time])
            return _image_source(path, dict(legacy.arrays), diagonal(legacy.spacing, legacy.origin), time)
        return _open_whole(path)
    return _open_vti(path)


def _image_source(path: Path, arrays: dict[str, Any], affine: np.ndarray, time: np.ndarray | None) -> Source:
    axes = {name: "zyx" + ("c" if len(array.shape) > 3 else "") for name, array in arrays.items()}

    def close() -> None:
        for array in arrays.values():
            if isinstance(array, Streamed):
                array.close()

    return Source(str(path), arrays, axes=axes, affine=affine, time=time, roles=_vector(arrays), close=close)


def _open_vti(path: Path) -> Source:
    """A VTI file by vtk, layer by layer."""
    try:
        from vtkmodules.vtkCommonDataModel import vtkDataObject
        from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
        from vtkmodules.vtkIOXML import vtkXMLImageDataReader
    except ImportError as fault:
        raise missing_extra(path, "vtk") from fault
    reader, faults = _watched(vtkXMLImageDataReader(), path)
    with quiet_vtk():
        reader.UpdateInformation()
    about = reader.GetOutputInformation(0)
    extent = about.Get(vtkStreamingDemandDrivenPipeline.WHOLE_EXTENT())
    listed = about.Get(vtkDataObject.POINT_DATA_VECTOR())
    if faults or extent is None or any(extent[2 * axis + 1] < extent[2 * axis] for axis in range(3)):
        raise FormatError(f"{path}: vtk finds no image data in it (VTI or legacy structured points)")
    nx, ny, nz = (extent[2 * axis + 1] - extent[2 * axis] + 1 for axis in range(3))
    arrays: dict[str, Slabs] = {}
    for number in range(listed.GetNumberOfInformationObjects() if listed is not None else 0):
        one = listed.GetInformationObject(number)
        count = one.Get(vtkDataObject.FIELD_NUMBER_OF_COMPONENTS())
        name = one.Get(vtkDataObject.FIELD_NAME())
        arrays[name] = Slabs(reader, name, (nz, ny, nx, *((count,) if count > 1 else ())), tuple(extent[::2]))
    reader.GetPointDataArraySelection().DisableAllArrays()
    with quiet_vtk():
        reader.UpdateExtent((extent[0], extent[0], extent[2], extent[2], extent[4], extent[4]))
    return _image_source(path, arrays, *_place_and_time(reader.GetOutput(), tuple(extent[::2])))


def _open_whole(path: Path) -> Source:
    """Legacy structured points that only vtk reads, all at once."""
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOLegacy import vtkStructuredPointsReader
    except ImportError as fault:
        raise missing_extra(path, "vtk") from fault
    reader, faults = _watched(vtkStructuredPointsReader(), path)
    with quiet_vtk():
        reader.Update()
    image = reader.GetOutput()
    if faults or image is None or image.GetNumberOfPoints() == 0:
        raise FormatError(f"{path}: vtk finds no image data in it (VTI or legacy structured points)")
    points, arrays = image.GetPointData(), {}
    for number in range(points.GetNumberOfArrays()):
        array = points.GetArray(number)
        if array is not None:
            values = vtk_to_numpy(array)
            arrays[array.GetName()] = values.reshape(*reversed(image.GetDimensions()), *values.shape[1:])
    return _image_source(path, arrays, *_place_and_time(image, tuple(image.GetExtent()[::2])))


def _watched(reader: Any, path: Path) -> tuple[Any, list[int]]:
    """A reader of a file, and a list that grows by each error that it reports."""
    faults: list[int] = []
    reader.AddObserver("ErrorEvent", lambda *_: faults.append(1))
    reader.SetFileName(str(path))
    return reader, faults


def _place_and_time(image: Any, first: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """The affine of an image whose first node has those numbers, and its time where it says one."""
    spacing, direction = image.GetSpacing(), image.GetDirectionMatrix()
    matrix = np.array([[direction.GetElement(i, j) for j in range(3)] for i in range(3)])
    affine = np.eye(4)
    affine[:3, :3] = matrix * np.array(spacing)
    affine[:3, 3] = np.array(image.GetOrigin()) + affine[:3, :3] @ np.array(first)
    stamp = image.GetFieldData().GetArray("TimeValue")
    return affine, None if stamp is None else np.array([stamp.GetValue(0)], np.float64)


def open_vtkhdf(path: Path) -> Source:
    """The point arrays of VTKHDF image data, of one time or of many."""
    file = h5py.File(path, "r")
    root = file["VTKHDF"]
    if text(root.attrs.get("Type", "")) != "ImageData":
        raise FormatError(f"{path}: holds VTKHDF {text(root.attrs.get('Type', ''))}, and ImageData is needed")
    arrays = datasets(root["PointData"]) if "PointData" in root else {}
    steps = root.get("Steps")
    stamp = root.get("FieldData/TimeValue") if steps is None else steps["Values"]
    time = None if stamp is None else np.asarray(stamp[()], np.float64).reshape(-1)
    extent = np.asarray(root.attrs["WholeExtent"])
    space, axes = "yx" if extent[4] == extent[5] else "zyx", {}
    for name, node in arrays.items():
        lead = "t" if steps is not None else ""
        axes[name] = lead + space + ("c" if node.ndim == len(lead) + len(space) + 1 else "")
    matrix = np.asarray(root.attrs.get("Direction", np.eye(3)), np.float64).reshape(3, 3)
    affine = np.eye(4)
    affine[:3, :3] = matrix * np.asarray(root.attrs["Spacing"], np.float64)
    affine[:3, 3] = np.asarray(root.attrs["Origin"], np.float64) + affine[:3, :3] @ extent[::2]
    return Source(str(path), arrays, axes=axes, affine=affine, time=time, roles=_vector(arrays), close=file.close)


def _vector(arrays: dict) -> dict[str, tuple[str, ...]]:
    """A velocity by its name, else the only vectors that there are; a mask by its name."""
    vectors = [name for name, array in arrays.items() if array.shape[-1:] == (3,) and len(array.shape) > 2]
    named = [name for name in vectors if "veloc" in name.lower()] or vectors
    roles = {"velocity": tuple(named)} if len(named) == 1 else {}
    return roles | {name: (name,) for name in ("mask", "weight") if name in arrays}
