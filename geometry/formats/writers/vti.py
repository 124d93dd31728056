"""VTI images, one for each frame, and VTP walls, with the `.series` files that ParaView opens; by the vtk package."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.formats.own.mark import MARK, marked
from geometry.formats.source import missing_extra
from geometry.recordings.recording import Recording

from .common import SCALARS, VECTORS, lattice, scalar, vector, wall_velocity

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkDataObject
    from vtkmodules.vtkIOXML import vtkXMLWriter


def write_vti(path: Path, recording: Recording) -> list[Path]:
    """`NAME_0000.vti`, ... and `NAME.vti.series`; the wall as `NAME_wall_0000.vtp`, ... likewise."""
    try:
        from vtkmodules.util.numpy_support import numpy_to_vtk
        from vtkmodules.vtkCommonDataModel import vtkImageData
        from vtkmodules.vtkIOXML import vtkXMLImageDataWriter
    except ImportError as fault:
        raise missing_extra(path, "vtk") from fault
    origin, spacing, counts = lattice(recording)
    names = []
    for frame in range(recording.frames):
        image = vtkImageData()
        image.SetOrigin(origin.tolist())
        image.SetSpacing(spacing.tolist())
        image.SetDimensions(counts)
        for name in (*VECTORS, *SCALARS):
            whole = vector(recording, name) if name in VECTORS else scalar(recording, name)
            if whole is None:
                continue
            values = np.moveaxis(whole[frame], 0, -1).reshape(-1, 3) if name in VECTORS else whole[frame].ravel()
            array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
            array.SetName(name)
            image.GetPointData().AddArray(array)
        stamp = numpy_to_vtk(recording.time[frame : frame + 1].copy(), deep=True)
        stamp.SetName("TimeValue")
        image.GetFieldData().AddArray(stamp)
        names.append(path.with_name(f"{path.stem}_{frame:04d}.vti"))
        _write(vtkXMLImageDataWriter(), image, names[-1])
    series = path.with_name(f"{path.stem}.vti.series")
    written = [_series(series, names, recording.time, {MARK: marked(recording)}), *names]
    return written + (_walls(path, recording) if recording.wall is not None else [])


def _walls(path: Path, recording: Recording) -> list[Path]:
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    wall, names = recording.wall_for("the walls' files"), []
    speed = wall_velocity(wall, recording.time)
    flat = 3 - recording.dimension
    for frame in range(recording.frames):
        mesh, points, cells = vtkPolyData(), vtkPoints(), vtkCellArray()
        points.SetData(numpy_to_vtk(np.pad(wall.at(frame).vertices, ((0, 0), (0, flat))), deep=True))
        size = np.full((len(wall.faces), 1), wall.faces.shape[1])
        listed = np.concatenate([size, wall.faces], axis=1).ravel().astype(np.int64)
        cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(listed, deep=True))
        mesh.SetPoints(points)
        (mesh.SetLines if flat else mesh.SetPolys)(cells)
        for data, name, values in (
            (mesh.GetPointData(), "velocity", np.pad(speed[frame], ((0, 0), (0, flat)))),
            (mesh.GetCellData(), "region", wall.region),
        ):
            array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
            array.SetName(name)
            data.AddArray(array)
        names.append(path.with_name(f"{path.stem}_wall_{frame:04d}.vtp"))
        _write(vtkXMLPolyDataWriter(), mesh, names[-1])
    return [_series(path.with_name(f"{path.stem}_wall.vtp.series"), names, recording.time), *names]


def _write(writer: vtkXMLWriter, data: vtkDataObject, path: Path) -> None:
    writer.SetFileName(str(path))
    writer.SetInputData(data)
    if writer.Write() != 1:
        raise OSError(f"{path}: vtk could not write it")


def _series(path: Path, names: list[Path], time: np.ndarray, more: dict[str, str] | None = None) -> Path:
    files = [{"name": name.name, "time": float(at)} for name, at in zip(names, time, strict=True)]
    path.write_text(json.dumps({"file-series-version": "1.0", "files": files} | (more or {})))
    return path
