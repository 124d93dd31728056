"""Surfaces from and to STL, OBJ and PLY files, by trimesh."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .repair import repaired
from .surface import Surface, SurfaceError

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".stl", ".obj", ".ply")
LARGEST = 1.0  # m; hearts are smaller, so a larger surface is in mm or cm


def read_surface(path: str | Path, *, scale: float = 1.0, mend: bool = True) -> Surface:
    """The triangles of a STL, OBJ or PLY file as a closed outward surface.

    `scale`: metres per unit of the file, 1e-3 for millimetres (these formats do not say). `mend`: merge
    seams, turn faces, close holes (`repaired`); STL always needs the merging. A PLY face property `region`
    gives the region labels, otherwise all faces are wall, region 0 (see `labelled`).

    Raises FileNotFoundError, and SurfaceError, which names the file, for other formats, files without
    triangles, surfaces larger than a metre and faults that cannot be mended.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.suffix.lower() not in SUFFIXES:
        raise SurfaceError(f"{path}: surfaces are read from {', '.join(SUFFIXES)}, not from {path.suffix or 'this'}")
    if not scale > 0:
        raise SurfaceError(f"{path}: scale must be positive (metres per unit of the file), not {scale}")
    mesh = _load(path)
    try:
        surface = Surface(np.asarray(mesh.vertices) * scale, mesh.faces, _region(mesh))
        lower, upper = surface.bounds
        if (upper - lower).max() > LARGEST:
            size = (upper - lower).max()
            raise SurfaceError(f"is {size:g} m large, so it is probably in mm or cm: pass scale=1e-3 or scale=1e-2")
        return repaired(surface) if mend else surface
    except SurfaceError as fault:
        raise SurfaceError(f"{path}: {fault}") from fault


def write_surface(path: str | Path, surface: Surface, *, scale: float = 1.0) -> None:
    """Write a 3-D surface as STL, OBJ or PLY by suffix, in units of `scale` (m); PLY keeps the regions."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise SurfaceError(f"{path}: surfaces are written to {', '.join(SUFFIXES)}, not to {path.suffix or 'this'}")
    mesh = surface.trimesh()
    mesh.vertices = mesh.vertices / scale
    mesh.export(path, file_type=path.suffix.lower()[1:])


def labelled(
    surface: Surface, region: int, *, centre: np.ndarray, radius: float, normal: np.ndarray | None = None
) -> Surface:
    """The same surface with the faces within `radius` (m) of `centre` (D,), m, labelled as `region`.

    Faces belong to it whose centroid lies within the radius and, with a `normal`, whose own normal is within
    60 degrees of it. Raises SurfaceError where there is none.
    """
    away = np.linalg.norm(surface.centroids - np.asarray(centre, np.float64), axis=1)
    chosen = away < radius
    if normal is not None:
        direction = np.asarray(normal, np.float64)
        chosen &= surface.normals @ direction > 0.5 * np.linalg.norm(direction)
    if not chosen.any():
        raise SurfaceError(
            f"labelled: no face lies within {radius:g} m of {centre}; the closest is {away.min():g} m away"
        )
    return Surface(surface.vertices, surface.faces, np.where(chosen, np.uint8(region), surface.region))


def _load(path: Path) -> trimesh.Trimesh:
    import trimesh  # half a second that most uses of the package need not wait

    options = {"skip_materials": True} if path.suffix.lower() == ".obj" else {}
    try:
        mesh = trimesh.load_mesh(path, process=False, **options)
    except Exception as fault:  # each of trimesh's readers has errors of its own kind
        raise SurfaceError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({fault})") from fault
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise SurfaceError(f"{path}: holds no triangles")
    return mesh


def _region(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Region labels that `write_surface` put into a PLY file."""
    raw = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    if raw is None or "region" not in (raw.dtype.names or ()):
        return None
    region = np.asarray(raw["region"]).reshape(-1)
    return region if len(region) == len(mesh.faces) else None
