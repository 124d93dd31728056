"""Walls from files, one or one per frame, and from masks, with openings where those are cut."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geometry.grids.grid import Grid
from geometry.recordings.recording import Wall
from geometry.surfaces.files import read_surface
from geometry.surfaces.segmentation import surface_from_mask
from geometry.surfaces.surface import Surface, SurfaceError, pieces_of

from .displacement import MotionOptions, read_displacements
from .source import FormatError

BEYOND = 0.25  # of a spacing: a face further outside the box of nodes closes a cut vessel
SMALL_CUT = 0.02  # of the area of the largest cut: smaller patches are the wall touching the grid's edge
MOST_OPENINGS = 8


def wall_from_files(
    paths: Sequence[Path],
    scale: float,
    *,
    openings: int = 0,
    unite: bool = False,
    sheet: str = "",
    turn: np.ndarray | None = None,
) -> Wall:
    """The wall at rest of one file, or the moving one of a file for each frame.

    The files of a series must have the same faces. The first one is mended, and all others are closed by the
    same faces, so that the wall keeps its topology.

    Args:
        paths: in order of time.
        scale: m per unit of the files.
        openings: how many of the longest holes are orifices; they get the regions 1, 2, ... in that order.
        unite: bodies that overlap become one.
        sheet: "inner" or "all" of a wall of finite thickness, which is refused without it.
        turn: (3, 3), from the recording's coordinates to the files'.

    Raises:
        FormatError: the files of a series differ in their faces.
        SurfaceError: a surface cannot be read or mended.
    """
    labels = tuple(range(1, openings + 1))
    whole = read_surface(paths[0], scale=scale, hole_region=labels, unite=unite, sheet=sheet)
    if len(paths) == 1:
        return Wall(_turned(whole.vertices, turn), whole.faces, whole.region)
    raw = read_surface(paths[0], scale=scale, mend=False)
    plan = _provenance(whole, raw, paths[0])
    frames = np.empty((len(paths), *whole.vertices.shape))
    for frame, path in enumerate(paths):
        surface = raw if frame == 0 else read_surface(path, scale=scale, mend=False)
        if not np.array_equal(surface.faces, raw.faces) or len(surface.vertices) != len(raw.vertices):
            raise FormatError(f"{path}: has other faces than {paths[0]}; a moving wall keeps its triangles over time")
        frames[frame] = _turned(plan @ surface.vertices, turn)
    return Wall(frames, whole.faces, whole.region)


def wall_by_displacements(
    path: Path,
    options: MotionOptions,
    scale: float,
    *,
    time: np.ndarray | None,
    period: float,
    openings: int = 0,
    unite: bool = False,
    sheet: str = "",
    turn: np.ndarray | None = None,
) -> tuple[Wall, np.ndarray | None]:
    """The wall of a file that moves by displacements, and their times where they have any.

    Args:
        path: of the surface where it has not moved.
        options: the displacements.
        scale: m per unit of the surface file.
        time: (T,), s, of the frames wanted; None: those of the displacements.
        period: s; 0 = not periodic.
        openings: how many of the longest holes are orifices.
        unite: bodies that overlap become one.
        sheet: "inner" or "all" of a wall of finite thickness, which is refused without it.
        turn: (3, 3), from the recording's coordinates to the files'.

    Raises:
        FormatError: the displacements cannot be read, or do not reach the wall or its frames.
        SurfaceError: the surface cannot be read or mended.
    """
    labels = tuple(range(1, openings + 1))
    whole = read_surface(path, scale=scale, hole_region=labels, unite=unite, sheet=sheet)
    raw = read_surface(path, scale=scale, mend=False)
    motion = read_displacements(options, raw.vertices, scale)
    plan = _provenance(whole, raw, path)
    frames = motion.moved(raw.vertices, time, period, Path(options.files[0]))
    vertices = np.stack([_turned(plan @ places, turn) for places in frames])
    return Wall(vertices, whole.faces, whole.region), motion.time


def wall_from_mask(mask: np.ndarray, grid: Grid, *, smoothing: int = 0) -> Wall:
    """A wall at rest around a mask, with orifices where the grid's edge cuts it.

    Args:
        mask: (T, *grid); its union over the frames is taken.
        grid: of the mask.
        smoothing: passes of Taubin's filter.

    Returns:
        Faces that close a cut get the regions 1, 2, ..., the largest first.
    """
    try:
        surface = surface_from_mask(np.asarray(mask.any(axis=0)), grid, smoothing=smoothing)
    except SurfaceError as fault:
        raise FormatError(f"no wall can be made from the mask: {fault}") from fault
    return Wall(surface.vertices, surface.faces, _cuts(surface, grid))


def inside_at(wall: Wall, frame: int, grid: Grid) -> np.ndarray:
    """The nodes inside the wall at a frame."""
    from geometry.surfaces.winding import grid_winding

    surface = wall.at(frame)
    return grid_winding(grid, surface.vertices, surface.faces) > 0


def _cuts(surface: Surface, grid: Grid) -> np.ndarray:
    region = np.zeros(len(surface.faces), np.uint8)
    step = BEYOND * np.asarray(grid.spacing)
    low, high = np.asarray(grid.origin) - step, np.asarray(grid.upper) + step
    patches = []
    for axis in range(grid.dimension):
        for side in (surface.centroids[:, axis] < low[axis], surface.centroids[:, axis] > high[axis]):
            faces = np.flatnonzero(side)
            if len(faces) == 0:
                continue
            label = pieces_of(surface.faces[faces], len(surface.vertices))
            patches += [faces[label == piece] for piece in range(label.max() + 1)]
    area = [surface.areas[patch].sum() for patch in patches]
    order = np.argsort(area)[::-1]
    kept = [patches[number] for number in order if area[number] > SMALL_CUT * max(area)]
    if sum(area) > 0.3 * surface.area or len(kept) > MOST_OPENINGS:
        return region  # the mask fills the grid: these are its edges, no vessels
    for number, patch in enumerate(kept, start=1):
        region[patch] = number
    return region


def _turned(vertices: np.ndarray, turn: np.ndarray | None) -> np.ndarray:
    return vertices if turn is None else vertices @ turn


def _provenance(whole: Surface, raw: Surface, path: Path) -> np.ndarray:
    """(nv, nv of the file): each mended vertex as the file's own vertex, or as the mean of a hole's rim."""
    from scipy.sparse import lil_array

    place = {tuple(point): number for number, point in reversed(list(enumerate(raw.vertices.tolist())))}
    plan = lil_array((len(whole.vertices), len(raw.vertices)))
    middles = []
    for number, point in enumerate(whole.vertices.tolist()):
        if tuple(point) in place:
            plan[number, place[tuple(point)]] = 1.0
        else:
            middles.append(number)
    for number in middles:
        around = np.setdiff1d(whole.faces[(whole.faces == number).any(axis=1)], number)
        rim = [place.get(tuple(point)) for point in whole.vertices[around].tolist()]
        if None in rim:
            raise FormatError(
                f"{path}: its mended vertices cannot be followed through the series; mend the files first"
            )
        plan[number, rim] = 1.0 / len(rim)
    return plan.tocsr()
