"""A wall of finite thickness: a closed surface around the wall's material, of which the blood touches the inner sheet.

Such a file may hold two closed sheets, one inside the other, or a single one whose sheets are joined at rims, as a
myocardium that is cut at its base or a vessel's wall between two cuts. Either way there is room outside of the material
that the material surrounds in most directions: the lumen. Around a body of blood there is next to none.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geometry.grids.grid import Grid

from .repair import repaired
from .surface import Surface, SurfaceError, pieces_of, ridges_of
from .winding import grid_winding

NODES = 40  # along the longest side of the box
SURROUNDED = 0.7  # part of the directions in which a point of the lumen sees material
FACING = 0.65  # the same, in front of a face of the inner sheet; half of it is behind any face
LUMEN = 0.06  # of lumen and material together; pits between trabeculae are smaller
NESTED = 0.03  # the same, of two closed sheets; bodies in the blood are smaller
HELD = 0.9  # part of the lumen that the inner sheet must hold
CLEARLY = 0.75  # the same, of the middle face of a smooth patch that belongs to the inner sheet as a whole
SHARP = 40.0  # degrees between faces, beyond which a patch ends
MIXED = 0.1  # part of a patch's area that decides otherwise, above which it is cut
BEYOND = 0.15  # part of what the inner sheet holds that may be material or lie beyond the lumen, along voxels
AT_A_TIME = 10_000  # points
DIRECTIONS = [step for step in product((-1, 0, 1), repeat=3) if any(step)]


@dataclass(frozen=True, eq=False)
class Shell:
    """What a surface encloses, and what it surrounds.

    Attributes:
        material: m^3, inside the surface.
        lumen: m^3, surrounded by it.
    """

    material: float
    lumen: float


@dataclass(frozen=True, eq=False)
class _Voxels:
    """Nodes around a surface: inside it or touched by it (`block`), and in how many directions they see such nodes."""

    grid: Grid
    inside: np.ndarray
    block: np.ndarray
    seen: np.ndarray

    @property
    def lumen(self) -> np.ndarray:
        return ~self.block & (self.seen >= SURROUNDED)


def shell_of(surface: Surface) -> Shell | None:
    """The material and the lumen, where a closed outward surface in space bounds a wall of finite thickness."""
    if surface.dimension != 3:
        return None
    volumes = surface.component_volumes
    hollow = -volumes[volumes < 0].sum()
    if hollow > NESTED * volumes[volumes > 0].sum():
        return Shell(float(volumes.sum()), float(hollow))
    voxels = _voxels(surface)
    lumen = float(voxels.lumen.sum()) * voxels.grid.cell_volume
    material = float(volumes.sum())
    return Shell(material, lumen) if lumen > LUMEN * (lumen + material) else None


def refuse_shells(surface: Surface) -> None:
    """Raise SurfaceError where a closed surface bounds a wall of finite thickness, not the blood."""
    shell = shell_of(surface)
    if shell is not None:
        raise SurfaceError(
            f"is a wall of finite thickness: {1e6 * shell.material:.3g} ml of material around "
            f"{1e6 * shell.lumen:.3g} ml; take its inner sheet: sheet='inner' (convert --sheet inner), or, if the "
            "blood is what it encloses, keep it whole: sheet='all'"
        )


def inner_sheet(surface: Surface, *, hole_region: int | Sequence[int] = 0) -> Surface:
    """The closed surface of the blood inside a wall of finite thickness.

    Args:
        surface: closed and outward, around the wall's material.
        hole_region: label of the faces that close the inner sheet where it was joined to the outer one; a sequence
            labels the longest rims, in order.

    Raises:
        SurfaceError: there is no inner sheet, or none that holds the lumen alone.
    """
    if surface.dimension != 3 or shell_of(surface) is None:
        raise SurfaceError("has no inner sheet: it surrounds no lumen; leave sheet='inner' (convert --sheet inner) out")
    volumes, label = surface.component_volumes, surface.component_labels
    if -volumes[volumes < 0].sum() > NESTED * volumes[volumes > 0].sum():
        deepest = int(volumes.argmin())
        found = _part(surface, label == deepest)
        if -volumes[deepest] < 0.9 * -volumes[volumes < 0].sum():
            raise SurfaceError("holds several closed sheets inside others; keep the blood's surface alone")
        return repaired(found, hole_region=hole_region)
    voxels = _voxels(surface)
    faces = _facing(surface, voxels)
    try:
        result = repaired(_part(surface, faces), hole_region=hole_region)
    except SurfaceError as fault:
        raise SurfaceError(
            f"is a wall whose inner sheet cannot be told from its rim ({fault}); cut it there"
        ) from fault
    held = grid_winding(voxels.grid, result.vertices, result.faces) > 0
    beyond = held & (voxels.inside | (~voxels.block & (voxels.seen < FACING)))
    if (held & voxels.lumen).sum() < HELD * voxels.lumen.sum() or beyond.sum() > BEYOND * held.sum():
        raise SurfaceError(
            "is a wall whose inner sheet cannot be told from its rim; keep the inner sheet alone in the program that "
            "made the surface"
        )
    return result


def _part(surface: Surface, faces: np.ndarray) -> Surface:
    """Some of the faces, turned over: what leads out of the material leads into the blood."""
    return Surface(surface.vertices, surface.faces[faces][:, ::-1], surface.region[faces])


def _voxels(surface: Surface) -> _Voxels:
    lower, upper = surface.bounds
    step = float((upper - lower).max()) / NODES
    grid = Grid.covering(tuple(lower - 2 * step), tuple(upper + 2 * step), step)
    inside = grid_winding(grid, surface.vertices, surface.faces) > 0
    block = inside.copy()
    for points in _points_on(surface, 0.5 * step):
        block[tuple(np.rint((points - grid.origin) / step).astype(np.int32).T[::-1])] = True
    seen = np.zeros(grid.shape, np.uint8)
    for direction in DIRECTIONS:
        seen += _sees(block, direction)
    return _Voxels(grid, inside, block, seen / np.float32(len(DIRECTIONS)))


def _sees(block: np.ndarray, direction: tuple[int, ...]) -> np.ndarray:
    """The nodes from which a ray along a direction meets the block; each round doubles how far it looks."""
    reached = _shifted(block, direction, 1)
    step = 1
    while step < max(block.shape):
        reached |= _shifted(reached, direction, step)
        step *= 2
    return reached


def _shifted(values: np.ndarray, direction: tuple[int, ...], steps: int) -> np.ndarray:
    """At each node the value so many steps along a direction; False beyond the edge."""
    result = np.zeros_like(values)
    source, target = [], []
    for count, along in zip(values.shape, direction, strict=True):
        move = along * steps
        if abs(move) >= count:
            return result
        source.append(slice(max(move, 0), count + min(move, 0)))
        target.append(slice(max(-move, 0), count + min(-move, 0)))
    result[tuple(target)] = values[tuple(source)]
    return result


def _points_on(surface: Surface, distance: float) -> Iterator[np.ndarray]:
    """Points (n, 3) on the faces, no farther apart than a distance (m), some faces at a time."""
    corner = surface.vertices[surface.faces]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(np.ceil(longest / distance), 1).astype(int)
    for count in np.unique(parts):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        kept = (i + j) <= count
        share = np.stack([i[kept], j[kept], count - i[kept] - j[kept]], axis=1) / count
        faces = np.flatnonzero(parts == count)
        for some in np.array_split(faces, -(-len(faces) * len(share) // AT_A_TIME)):
            yield np.einsum("pk,fkd->fpd", share, corner[some]).reshape(-1, 3)


def _patches(surface: Surface) -> np.ndarray:
    """The smooth patch of each face: neighbours belong together unless the edge between them is sharp."""
    place, _ = ridges_of(surface.faces, len(surface.vertices))
    owner = np.tile(np.arange(len(surface.faces)), len(place) // len(surface.faces))
    order = np.argsort(place, kind="stable")
    pairs = owner[order].reshape(-1, 2)  # a closed surface has two faces at each edge
    smooth = (surface.normals[pairs[:, 0]] * surface.normals[pairs[:, 1]]).sum(1) > np.cos(np.radians(SHARP))
    rows, columns = pairs[smooth].T
    count = len(surface.faces)
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _facing(surface: Surface, voxels: _Voxels) -> np.ndarray:
    """The faces that look into the lumen: the largest connected set of them, without specks and holes."""
    grid, step = voxels.grid, voxels.grid.spacing[0]
    seen = np.full(len(surface.faces), np.nan)
    for reach in (1.5, 2.0, 1.0):  # the first open node in front of a face
        place = np.rint((surface.centroids + reach * step * surface.normals - grid.origin) / step).astype(int)
        node = tuple(np.clip(place, 0, np.array(grid.shape[::-1]) - 1).T[::-1])
        free = np.isnan(seen) & ~voxels.block[node]
        seen[free] = voxels.seen[node][free]
    seen = np.nan_to_num(seen, nan=1.0)
    facing = seen >= FACING
    patch = _patches(surface)
    for number in range(patch.max() + 1):
        faces = np.flatnonzero(patch == number)
        share = surface.areas[faces][facing[faces]].sum() / max(surface.areas[faces].sum(), 1e-300)
        if not MIXED < share < 1 - MIXED:
            facing[faces] = share >= 0.5 and np.median(seen[faces]) >= CLEARLY
    if not facing.any():
        raise SurfaceError("is a wall whose inner sheet cannot be found; keep the inner sheet alone")
    for wanted in (True, False):  # first the largest set, then the holes in it
        chosen = np.flatnonzero(facing == wanted)
        if len(chosen) == 0:
            continue
        label = pieces_of(surface.faces[chosen], len(surface.vertices))
        area = np.bincount(label, weights=surface.areas[chosen])
        facing[chosen[label != area.argmax()]] = not wanted
    return facing
