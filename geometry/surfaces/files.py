"""Surfaces from and to files: STL, OBJ, PLY, VTP, legacy VTK."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from geometry.arguments import ENDLESS, POSITIVE, checked, finite

from .integers import region_number
from .overlap import refuse_overlaps, united
from .readers.obj import read_obj
from .readers.ply import read_ply
from .readers.polygons import PolygonError, Polygons
from .readers.stl import read_stl
from .readers.vtk_poly import read_vtk_polygons
from .repair import repaired
from .shells import inner_sheet, refuse_shells
from .surface import Surface, SurfaceError

READERS: dict[str, Callable[[Path], Polygons]] = {
    ".stl": read_stl,
    ".obj": read_obj,
    ".ply": read_ply,
    ".vtp": read_vtk_polygons,
    ".vtk": read_vtk_polygons,
}
SUFFIXES = tuple(READERS)
WRITTEN = (".stl", ".obj", ".ply")
SHEETS = ("", "inner", "all")
LARGEST = 1.0  # m; hearts are smaller, so a larger surface is in mm or cm


@checked
def read_surface(
    path: str | Path,
    *,
    scale: float = 1.0,
    mend: bool = True,
    unite: bool = False,
    sheet: str = "",
    hole_region: int | Sequence[int] = 0,
) -> Surface:
    """The triangles of a STL, OBJ, PLY, VTP or legacy VTK file as a closed outward surface.

    Args:
        path: the file. Polygons of more corners are cut into triangles, which keep their polygon's label.
        scale: metres per unit of the file, 1e-3 for millimetres (these formats do not say).
        mend: merge seams, turn faces, close holes (`repaired`); STL always needs the merging.
        unite: closed bodies that overlap become one, with manifold3d; otherwise they are refused.
        sheet: of a wall of finite thickness, "inner" takes the blood's surface, "all" leaves the material as what is
            enclosed; with neither such a file is refused.
        hole_region: label of the faces that close holes; a sequence labels the longest holes, in order.

    Returns:
        The surface. A face property `region` of a PLY or VTP file gives the labels, otherwise all faces are
        wall, region 0 (see `labelled`).

    Raises:
        FileNotFoundError: there is no such file.
        SurfaceError: names the file, for other formats, files without triangles, surfaces larger than a metre,
            faults that cannot be mended, bodies that overlap and walls of finite thickness.
    """
    path = Path(path)
    if sheet not in SHEETS:
        raise SurfaceError(f"{path}: sheet must be one of {', '.join(SHEETS[1:])} or empty, not {sheet!r}")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    if path.suffix.lower() not in READERS:
        raise SurfaceError(f"{path}: surfaces are read from {', '.join(SUFFIXES)}, not from {path.suffix or 'this'}")
    if not scale > 0:
        raise SurfaceError(f"{path}: scale must be positive (metres per unit of the file), not {scale}")
    try:
        surface, names = _surface(path, scale)
        lower, upper = surface.bounds
        if (upper - lower).max() > LARGEST:
            size = (upper - lower).max()
            raise SurfaceError(f"is {size:g} m large, so it is probably in mm or cm: pass scale=1e-3 or scale=1e-2")
        if not mend:
            return surface
        whole = repaired(surface, hole_region=hole_region)
        if unite:
            whole = united(whole)
        else:
            refuse_overlaps(whole, _names_of_pieces(whole, surface, names))
        return _sheet(whole, sheet, hole_region)
    except (SurfaceError, PolygonError) as fault:
        raise SurfaceError(f"{path}: {fault}") from fault


@checked
def holds_surface(path: Path) -> bool:
    """Whether a file is one of surfaces, by the end of its name and, for legacy VTK, by what it says it holds."""
    suffix = path.suffix.lower()
    if suffix != ".vtk":
        return suffix in READERS
    with path.open("rb") as file:
        return b"POLYDATA" in file.read(1024).upper()


@checked(scale=POSITIVE)
def write_surface(path: str | Path, surface: Surface, *, scale: float = 1.0) -> None:
    """Write a 3-D surface as STL, OBJ or PLY by suffix, in units of `scale` (m); PLY keeps the regions."""
    path = Path(path)
    if path.suffix.lower() not in WRITTEN:
        raise SurfaceError(f"{path}: surfaces are written to {', '.join(WRITTEN)}, not to {path.suffix or 'this'}")
    mesh = surface.trimesh()
    mesh.vertices = mesh.vertices / scale
    mesh.export(path, file_type=path.suffix.lower()[1:])


@checked(centre=finite(), radius=ENDLESS, normal=finite())
def labelled(
    surface: Surface, region: int, *, centre: np.ndarray, radius: float, normal: np.ndarray | None = None
) -> Surface:
    """The same surface with the faces around a point labelled.

    Args:
        surface: the surface.
        region: the new label.
        centre: (D,), m.
        radius: m; faces whose centroid lies closer to the centre are labelled.
        normal: (D,), any length; if given, only faces whose own normal is within 60 degrees of it.

    Raises:
        SurfaceError: no face is meant.
    """
    region = region_number("labelled: region", region)
    if np.shape(centre) != (surface.dimension,):
        raise SurfaceError(f"labelled: centre must be {surface.dimension} numbers (m), not {centre!r:.80}")
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


def _surface(path: Path, scale: float) -> tuple[Surface, Sequence[str] | None]:
    """The file's triangles, m, and the name of the body of each."""
    polygons = READERS[path.suffix.lower()](path)
    if len(polygons.sizes) == 0:
        raise SurfaceError("holds no triangles")
    faces, owner = polygons.triangles()
    names = None if polygons.names is None else [polygons.names[number] for number in owner.tolist()]
    return Surface(polygons.vertices * scale, faces, _labels(polygons.region, owner)), names


def _labels(region: np.ndarray | None, owner: np.ndarray) -> np.ndarray:
    """Labels of the triangles as whole numbers from 0 to 255."""
    if region is None:
        return np.zeros(len(owner), np.uint8)
    values = np.asarray(region, np.float64).reshape(-1)[owner]
    if ((values != np.rint(values)) | (values < 0) | (values > 255)).any():
        raise SurfaceError(f"its face property of regions must hold whole numbers from 0 to 255, not {values.max():g}")
    return values.astype(np.uint8)


def _sheet(whole: Surface, sheet: str, hole_region: int | Sequence[int]) -> Surface:
    """The blood's surface: all that the file holds, or the inner sheet of a wall."""
    if sheet == "inner":
        return inner_sheet(whole, hole_region=hole_region)
    if sheet != "all":
        refuse_shells(whole)
    return whole


def _names_of_pieces(whole: Surface, raw: Surface, names: Sequence[str] | None) -> list[str]:
    """What the file calls each connected piece, "" where it does not say."""
    first = np.unique(whole.component_labels, return_index=True)[1]
    if names is None:
        return [""] * len(first)
    known = {tuple(sorted(corner)): name for corner, name in zip(_corners(raw), names, strict=True)}
    corners = _corners(whole)
    return [known.get(tuple(sorted(corners[face])), "") for face in first.tolist()]


def _corners(surface: Surface) -> list[list[tuple[float, ...]]]:
    return [[tuple(point) for point in face] for face in surface.vertices[surface.faces].tolist()]
