"""VTK images: VTI and legacy .vtk by the vtk package, VTKHDF image data by h5py."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from geometry.formats.source import FormatError, Source, missing_extra

from .hdf5 import datasets, text


def open_vtk_image(path: Path) -> Source:
    """The point arrays of a VTI file or of legacy structured points, with its direction matrix and time."""
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOLegacy import vtkStructuredPointsReader
        from vtkmodules.vtkIOXML import vtkXMLImageDataReader
    except ImportError as fault:
        raise missing_extra(path, "vtk") from fault
    reader = vtkXMLImageDataReader() if path.suffix.lower() == ".vti" else vtkStructuredPointsReader()
    faults: list[int] = []
    reader.AddObserver("ErrorEvent", lambda *_: faults.append(1))
    reader.SetFileName(str(path))
    reader.Update()
    image = reader.GetOutput()
    if faults or image is None or image.GetNumberOfPoints() == 0:
        raise FormatError(f"{path}: vtk finds no image data in it (VTI or legacy structured points)")
    counts = image.GetDimensions()
    points, arrays, axes = image.GetPointData(), {}, {}
    for number in range(points.GetNumberOfArrays()):
        array = points.GetArray(number)
        if array is None:
            continue
        values = vtk_to_numpy(array)
        vector = values.ndim > 1
        arrays[array.GetName()] = values.reshape(*reversed(counts), *values.shape[1:])
        axes[array.GetName()] = "zyx" + ("c" if vector else "")
    spacing, direction = image.GetSpacing(), image.GetDirectionMatrix()
    matrix = np.array([[direction.GetElement(i, j) for j in range(3)] for i in range(3)])
    affine = np.eye(4)
    affine[:3, :3] = matrix * np.array(spacing)
    first = np.array([image.GetExtent()[2 * axis] for axis in range(3)])
    affine[:3, 3] = np.array(image.GetOrigin()) + affine[:3, :3] @ first
    stamp = image.GetFieldData().GetArray("TimeValue")
    time = None if stamp is None else vtk_to_numpy(stamp).astype(np.float64)[:1]
    return Source(str(path), arrays, axes=axes, affine=affine, time=time, roles=_vector(arrays))


def open_vtkhdf(path: Path) -> Source:
    """The point arrays of VTKHDF image data, of one time or of many."""
    file = h5py.File(path, "r")
    root = file["VTKHDF"]
    if text(root.attrs.get("Type", "")) != "ImageData":
        raise FormatError(f"{path}: holds VTKHDF {text(root.attrs.get('Type', ''))}, and ImageData is needed")
    arrays = datasets(root["PointData"]) if "PointData" in root else {}
    steps = root.get("Steps")
    time = None if steps is None else np.asarray(steps["Values"][()], np.float64)
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
