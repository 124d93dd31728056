"""STL files, by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .polygons import PolygonError, Polygons


def read_stl(path: Path) -> Polygons:
    """The triangles of a STL file, ASCII or binary; every triangle has corners of its own.

    Raises:
        PolygonError: trimesh cannot read the file.
    """
    import trimesh  # half a second that most uses of the package need not wait

    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as fault:  # trimesh's readers have errors of their own kinds
        raise PolygonError(f"cannot be read ({fault})") from fault
    if not isinstance(mesh, trimesh.Trimesh):
        raise PolygonError("holds no triangles")
    corners = np.asarray(mesh.faces, np.int64).ravel()
    return Polygons(np.asarray(mesh.vertices), corners, np.full(len(corners) // 3, 3))
