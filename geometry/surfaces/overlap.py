"""Closed bodies that overlap: found, refused by name, or united.

The volume of a surface is the sum over its bodies, so that two that overlap would be counted twice where they
do, while the signed distance sees their union. Bodies that only touch, and bodies inside one another (an
outer wall and a cavity), do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from itertools import combinations

import numpy as np

from .closest import SurfaceIndex
from .surface import Surface, SurfaceError
from .winding import winding_number

PAIRS = 2_000_000  # edge-face pairs at a time
SAMPLE = 400  # vertices of a body whose side of another one is looked at before its edges are
CLEAR = 1e-6  # of the length of an edge: a crossing so close to its end is a touch


def refuse_overlaps(surface: Surface, names: Sequence[str] | None = None) -> None:
    """Raise SurfaceError where closed bodies of a surface overlap.

    Args:
        surface: a closed, outward surface.
        names: of its connected pieces, "" for one without a name.
    """
    found = overlapping_pieces(surface)
    if not found:
        return
    named = " and ".join(_called(surface, piece, names) for piece in found[0])
    more = f" (and {len(found) - 1} more pairs)" if len(found) > 1 else ""
    raise SurfaceError(
        f"its bodies overlap: {named}{more}; their volumes would be counted twice. Unite them: unite=True "
        "(convert --unite), or in the program that made the surface"
    )


def overlapping_pieces(surface: Surface) -> list[tuple[int, int]]:
    """Pairs of connected pieces of a closed surface whose sheets cross one another."""
    label = surface.component_labels
    count = int(label.max()) + 1
    if count == 1:
        return []
    parts = [surface.faces[label == piece] for piece in range(count)]
    boxes = [(surface.vertices[part.ravel()].min(0), surface.vertices[part.ravel()].max(0)) for part in parts]
    pairs = [
        (a, b)
        for a, b in combinations(range(count), 2)
        if (boxes[a][0] < boxes[b][1]).all() and (boxes[b][0] < boxes[a][1]).all()
    ]
    return [(a, b) for a, b in pairs if _cross(surface.vertices, parts[a], parts[b])]


def united(surface: Surface) -> Surface:
    """The union of the closed bodies of a surface, by manifold3d; labels from the nearest old face.

    Raises:
        SurfaceError: manifold3d is not installed, the surface is plane or no union comes out.
    """
    if not overlapping_pieces(surface):
        return surface
    if surface.dimension != 3:
        raise SurfaceError("overlapping outlines of a plane surface are not united; draw them as one")
    if find_spec("manifold3d") is None:
        raise SurfaceError('uniting bodies needs manifold3d: python -m pip install "torchsph[formats]"')
    import trimesh  # half a second that most uses of the package need not wait

    volumes, label = surface.component_volumes, surface.component_labels
    bodies = [
        trimesh.Trimesh(surface.vertices, surface.faces[label == piece], process=True)
        for piece in range(len(volumes))
        if volumes[piece] > 0
    ]
    whole = trimesh.boolean.union(bodies, engine="manifold")
    cavities = [
        trimesh.Trimesh(surface.vertices, surface.faces[label == piece][:, ::-1], process=True)
        for piece in np.flatnonzero(volumes < 0)
    ]
    if cavities:
        whole = trimesh.boolean.difference([whole, *cavities], engine="manifold")
    result = Surface(np.asarray(whole.vertices), np.asarray(whole.faces))
    nearest = SurfaceIndex(surface).query(result.centroids).face
    result = Surface(result.vertices, result.faces, surface.region[nearest])
    result.check()
    return result


def _called(surface: Surface, piece: int, names: Sequence[str] | None) -> str:
    corner = surface.vertices[surface.faces[surface.component_labels == piece].ravel()]
    centre = ", ".join(f"{1e3 * value:.3g}" for value in 0.5 * (corner.min(0) + corner.max(0)))
    name = f"'{names[piece]}'" if names and names[piece] else f"body {piece + 1}"
    return f"{name} around ({centre}) mm"


def _cross(vertices: np.ndarray, one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two closed pieces cross: vertices of one on both sides of the other, or an edge through a face."""
    for mine, theirs in ((one, other), (other, one)):
        used = np.unique(mine)
        used = used[:: max(1, len(used) // SAMPLE)]
        winding = np.abs(winding_number(vertices, theirs, vertices[used]))
        if (winding > 0.75).any() and (winding < 0.25).any():
            return True
    if vertices.shape[1] == 2:
        return False
    return _edges_pierce(vertices, one, other) or _edges_pierce(vertices, other, one)


def _edges_pierce(vertices: np.ndarray, one: np.ndarray, other: np.ndarray) -> bool:
    """Whether an edge of the first piece passes through the inside of a face of the second."""
    edges = np.unique(np.sort(one[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    ends, corners = vertices[edges], vertices[other]
    ends = ends[_within(ends, corners)]
    corners = corners[_within(corners, ends)] if len(ends) else corners[:0]
    rows = max(1, PAIRS // max(len(corners), 1))
    return any(_pierced(ends[at : at + rows], corners) for at in range(0, len(ends), rows)) if len(corners) else False


def _within(shapes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which of the shapes `(n, k, 3)` reach into the box around the others."""
    lower, upper = others.min(axis=(0, 1)), others.max(axis=(0, 1))
    return ((shapes.min(axis=1) <= upper) & (shapes.max(axis=1) >= lower)).all(axis=1)


def _pierced(ends: np.ndarray, corners: np.ndarray) -> bool:
    """Moeller and Trumbore 1997, "Fast, minimum storage ray/triangle intersection", sec. 2.6; touches are none."""
    origin, along = ends[:, None, 0], (ends[:, 1] - ends[:, 0])[:, None]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    side = np.cross(along, second)
    scale = (first * side).sum(-1)
    parallel = np.abs(scale) < 1e-12 * np.linalg.norm(along, axis=-1) * np.linalg.norm(np.cross(first, second), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - corners[:, 0]
        u = (offset * side).sum(-1) / scale
        turned = np.cross(offset, first)
        v = (along * turned).sum(-1) / scale
        t = (second * turned).sum(-1) / scale
        inside = (u > CLEAR) & (v > CLEAR) & (u + v < 1 - CLEAR) & (t > CLEAR) & (t < 1 - CLEAR)
    return bool((inside & ~parallel).any())
