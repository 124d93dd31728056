"""VTK polygons (.vtp, legacy .vtk), by the vtk package, which is an extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .polygons import PolygonError, Polygons
from .quiet_vtk import quiet_vtk

LABELS = ("region", "label", "RegionId", "CellEntityIds", "ModelFaceID")


def read_vtk_polygons(path: Path) -> Polygons:
    """Polygons and triangle strips of a VTP or legacy VTK file; a cell array `region` gives the regions.

    Raises:
        PolygonError: vtk is not installed, or the file is no polygonal data.
    """
    try:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkFiltersCore import vtkTriangleFilter
        from vtkmodules.vtkIOLegacy import vtkPolyDataReader
        from vtkmodules.vtkIOXML import vtkXMLPolyDataReader
    except ImportError as fault:
        raise PolygonError('needs the package vtk: python -m pip install "torchsph[formats]"') from fault
    reader = vtkXMLPolyDataReader() if path.suffix.lower() == ".vtp" else vtkPolyDataReader()
    reader.SetFileName(str(path))
    faults: list[str] = []
    reader.AddObserver("ErrorEvent", lambda *_: faults.append("vtk cannot read it"))
    cut = vtkTriangleFilter()
    with quiet_vtk():
        reader.Update()
        cut.SetInputData(reader.GetOutput())
        cut.PassLinesOff()
        cut.PassVertsOff()
        cut.Update()
    mesh = cut.GetOutput()
    if faults or mesh.GetNumberOfPolys() == 0:
        raise PolygonError(faults[0] if faults else "holds no triangles")
    corners = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).astype(np.int64)
    cells = mesh.GetCellData()
    label = next((cells.GetArray(name) for name in LABELS if cells.GetArray(name) is not None), None)
    region = None if label is None else vtk_to_numpy(label).copy()
    points = vtk_to_numpy(mesh.GetPoints().GetData()).astype(np.float64)
    return Polygons(points, corners, np.full(len(corners) // 3, 3), region)
