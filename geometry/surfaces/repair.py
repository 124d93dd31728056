"""Mending a surface: seams merged, faces numbered alike, holes closed, every piece turned outwards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from geometry.arguments import checked

from .holes import least_area_triangles, star_shaped
from .integers import region_number
from .surface import Surface, SurfaceError, ridges_of


@checked
def repaired(surface: Surface, *, merge: float | None = None, hole_region: int | Sequence[int] = 0) -> Surface:
    """The closed, consistently numbered, outward surface that a faulty one was meant to be.

    Vertices within `merge` (m; default 1e-7 of the box's diagonal) become one, faces without extent and
    second copies of a face are dropped, neighbours are numbered alike, each hole is closed by a fan of faces
    (along its rim where that is not star-shaped; a single edge in a plane) of region `hole_region`, and every
    piece is turned so that its normals leave the blood. A surface that is sound comes back with the same faces
    in the same order. A sequence of labels is given to the holes in order of the lengths of their rims, the
    longest first; the holes that are left are wall, region 0.

    Raises:
        SurfaceError: that is not enough, as where three faces meet at an edge.
    """
    lower, upper = surface.bounds
    tolerance = 1e-7 * float(np.linalg.norm(upper - lower)) if merge is None else merge
    if not tolerance >= 0:
        raise SurfaceError(f"repaired: merge must be a length (m) that is not negative, not {merge}")
    result = _deduplicated(_merged(surface, tolerance))
    result = Surface(result.vertices, _numbered_alike(result), result.region)
    result = _closed(result, hole_region)
    wrong = result.reversed_components()[result.component_labels]
    faces = np.where(wrong[:, None], result.faces[:, ::-1], result.faces)
    result = _compacted(Surface(result.vertices, faces, result.region))
    try:
        result.check()
    except SurfaceError as fault:
        text = str(fault).split(";")[0]
        raise SurfaceError(f"the surface cannot be mended: {text}; cut it where sheets cross or branch") from fault
    return result


def _merged(surface: Surface, tolerance: float) -> Surface:
    """Vertices closer than the tolerance replaced by the first of them."""
    count = len(surface.vertices)
    pairs = cKDTree(surface.vertices).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    first = np.unique(label, return_index=True)[1]
    return Surface(surface.vertices, first[label][surface.faces], surface.region)


def _deduplicated(surface: Surface) -> Surface:
    """Without faces that use a vertex twice, and with one of all faces that have the same vertices."""
    key = np.sort(surface.faces, axis=1)
    distinct = (np.diff(key, axis=1) > 0).all(axis=1)
    once = np.zeros(len(key), bool)
    once[np.unique(key, axis=0, return_index=True)[1]] = True
    keep = distinct & once
    if not keep.any():
        raise SurfaceError("the surface cannot be mended: none of its faces has an extent")
    return Surface(surface.vertices, surface.faces[keep], surface.region[keep])


def _numbered_alike(surface: Surface) -> np.ndarray:
    """Faces turned so that neighbours across edges of two faces agree with the first face of their piece."""
    place, sign = ridges_of(surface.faces, len(surface.vertices))
    owner = np.tile(np.arange(len(surface.faces)), len(place) // len(surface.faces))
    order = np.argsort(place, kind="stable")
    count = np.bincount(place)
    start = (np.cumsum(count) - count)[count == 2]
    one, other = order[start], order[start + 1]
    # Twins pass their common edge in opposite directions; equal signs mean that one of them has to be turned.
    turn = (sign[one] == sign[other]).astype(np.int8)
    a, b = owner[one], owner[other]
    size = (len(surface.faces),) * 2
    graph = coo_array((np.ones(2 * len(a), np.int8), (np.r_[a, b], np.r_[b, a])), shape=size).tocsr()
    relation = csr_array(coo_array((np.r_[turn, turn], (np.r_[a, b], np.r_[b, a])), shape=size))
    flip = np.zeros(len(surface.faces), bool)
    piece = connected_components(graph, directed=False)[1]
    for root in np.unique(piece, return_index=True)[1]:
        reached, before = breadth_first_order(graph, root, directed=False)
        parent = before[reached[1:]]
        change = np.asarray(relation[reached[1:], parent]).ravel() % 2 == 1 if len(parent) else []
        for face, ancestor, differs in zip(reached[1:].tolist(), parent.tolist(), change, strict=True):
            flip[face] = flip[ancestor] ^ bool(differs)
    return np.where(flip[:, None], surface.faces[:, ::-1], surface.faces)


def _closed(surface: Surface, region: int | Sequence[int]) -> Surface:
    """Every hole closed: in a plane by an edge between the ends, else by a fan or along its rim."""
    if surface.open_ridges == 0:
        return surface
    labels, rest = [], 0
    if isinstance(region, Sequence):
        labels = [region_number("hole_region", one) for one in region]
    else:
        rest = region_number("hole_region", region)
    if surface.dimension == 2:
        starts = np.setdiff1d(surface.faces[:, 0], surface.faces[:, 1])
        ends = np.setdiff1d(surface.faces[:, 1], surface.faces[:, 0])
        if len(starts) != 1 or len(ends) != 1:
            raise SurfaceError(
                "the outline cannot be mended: it has several gaps, and which ends belong together is open"
            )
        label = labels[0] if labels else rest
        return _with_faces(surface, surface.vertices, np.array([[ends[0], starts[0]]]), [label])
    vertices, caps, given = [surface.vertices], [], []
    total = len(surface.vertices)
    loops = rims(surface.faces)
    if labels:
        loops.sort(key=lambda loop: -_length(surface.vertices[loop]))
    for number, loop in enumerate(loops):
        if len(loop) == 3 or star_shaped(surface.vertices[loop]):
            cap = np.array([loop[::-1]]) if len(loop) == 3 else _fan(loop, total)
        else:
            cap = loop[least_area_triangles(surface.vertices[loop])][:, ::-1]
        if cap.max() >= total:
            vertices.append(surface.vertices[loop].mean(axis=0, keepdims=True))
            total += 1
        caps.append(cap)
        given += [labels[number] if number < len(labels) else rest] * len(cap)
    return _with_faces(surface, np.concatenate(vertices), np.concatenate(caps), given)


def _fan(loop: np.ndarray, middle: int) -> np.ndarray:
    return np.column_stack([np.roll(loop, -1), loop, np.full(len(loop), middle)])


def _length(rim: np.ndarray) -> float:
    return float(np.linalg.norm(rim - np.roll(rim, -1, axis=0), axis=1).sum())


def rims(faces: np.ndarray) -> list[np.ndarray]:
    """The closed chains of vertices around a set of triangles, in the sense of its faces, longest first."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    count = int(edges.max()) + 1 if len(edges) else 0
    forward = edges[:, 0].astype(np.int64) * count + edges[:, 1]
    backward = edges[:, 1].astype(np.int64) * count + edges[:, 0]
    following: dict[int, list[int]] = {}
    for a, b in edges[~np.isin(forward, backward)].tolist():
        following.setdefault(a, []).append(b)
    loops = []
    while following:
        start = at = next(iter(following))
        loop = []
        while at in following:
            loop.append(at)
            ahead = following[at].pop()
            if not following[at]:
                del following[at]
            at = ahead
        if at != start:
            raise SurfaceError(
                "the surface cannot be mended: the rim of a hole does not close; faces cross or branch there"
            )
        loops.append(np.array(loop))
    return sorted(loops, key=len, reverse=True)


def _with_faces(surface: Surface, vertices: np.ndarray, faces: np.ndarray, labels: Sequence[int]) -> Surface:
    region = np.concatenate([surface.region, np.asarray(labels, np.uint8)])
    return Surface(vertices, np.concatenate([surface.faces, faces]), region)


def _compacted(surface: Surface) -> Surface:
    """Without vertices that no face uses."""
    used, place = np.unique(surface.faces, return_inverse=True)
    return Surface(surface.vertices[used], place.reshape(surface.faces.shape), surface.region)
