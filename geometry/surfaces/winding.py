"""How often a closed surface winds around a point: 1 inside, 0 outside, 2 where two sheets of it overlap.

Two ways: for scattered points the sum of solid angles, which also gives a fair fraction for a surface with
holes (Jacobson, Kavan and Sorkine-Hornung 2013, "Robust inside-outside segmentation using generalized winding
numbers", eq. 5), and for all nodes of a grid the signed crossings of the grid's lines, which costs next to
nothing. Neither needs normals, so both hold for surfaces that touch or cut themselves.
"""

from __future__ import annotations

import numpy as np

from geometry.arguments import checked, finite
from geometry.grids.grid import Grid

CHUNK = 4_000_000  # point-face pairs at a time, about 0.5 GB of scratch memory


@checked(vertices=finite(), points=finite())
def winding_number(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Winding number of a surface `(nv, D), (nf, D)` around points `(n, D)`: float `(n,)`; D is 2 or 3.

    Cost is points times faces: meant for few points or as an independent check.

    Raises:
        ValueError: shapes that do not fit each other, values that are not finite, faces of vertices there are not.
    """
    faces = _checked_faces("winding_number", vertices, faces)
    if points.ndim != 2 or points.shape[1] != vertices.shape[1]:
        wanted = f"(n, {vertices.shape[1]}), as the vertices"
        raise ValueError(f"winding_number: points must be {wanted}, not {points.shape}")
    rows = max(1, CHUNK // max(len(faces), 1))
    angle = _plane_angle if points.shape[1] == 2 else _solid_angle
    corners = vertices[faces]
    chunks = [angle(corners, points[start : start + rows]) for start in range(0, len(points), rows)]
    return np.concatenate(chunks) if chunks else np.zeros(0)


def _checked_faces(name: str, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces as whole numbers, each of a vertex that there is."""
    if vertices.ndim != 2 or vertices.shape[1] not in (2, 3):
        raise ValueError(f"{name}: vertices must be (nv, 2) or (nv, 3), not {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != vertices.shape[1]:
        raise ValueError(f"{name}: faces must be (nf, {vertices.shape[1]}), as the vertices, not {faces.shape}")
    if faces.dtype.kind not in "iu":
        raise TypeError(f"{name}: faces must hold whole numbers, not {faces.dtype}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        there = f"0 to {len(vertices) - 1}, not {faces.min()} to {faces.max()}"
        raise ValueError(f"{name}: faces must number vertices {there}")
    return faces


def _plane_angle(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b = (corners[None, :, k] - points[:, None] for k in range(2))
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.arctan2(cross, (a * b).sum(-1)).sum(1) / (2 * np.pi)


def _solid_angle(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Van Oosterom and Strackee 1983, "The solid angle of a plane triangle", eq. 8."""
    a, b, c = (corners[None, :, k] - points[:, None] for k in range(3))
    na, nb, nc = (np.sqrt((side * side).sum(-1)) for side in (a, b, c))
    above = (a * np.cross(b, c)).sum(-1)
    below = na * nb * nc + (a * b).sum(-1) * nc + (b * c).sum(-1) * na + (c * a).sum(-1) * nb
    return np.arctan2(above, below).sum(1) / (2 * np.pi)


@checked(vertices=finite())
def grid_winding(grid: Grid, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding number at every node of a grid: int32 `shape`.

    Along each grid line in the last coordinate direction the surface is crossed where the line pierces a
    face; a face that is left outwards counts +1 for all nodes before it. The lines are moved aside by 1e-7 of
    the spacing, so that they do not meet the vertices and edges of meshes that sit on the nodes; nodes closer
    to the surface than that may fall on either side.

    Raises:
        ValueError: shapes that do not fit each other, values that are not finite, faces of vertices there are not.
    """
    faces = _checked_faces("grid_winding", vertices, faces)
    dimension = grid.dimension
    if vertices.shape[1] != dimension:
        raise ValueError(f"grid_winding: vertices must be (nv, {dimension}), as the grid, not {vertices.shape}")
    lateral = (
        np.asarray(grid.origin[:-1])
        + 1e-7 * np.asarray(grid.spacing[:-1]) * np.array([0.8191, 0.5736])[: dimension - 1]
    )
    place = (vertices[:, :-1] - lateral) / np.asarray(grid.spacing[:-1])  # in lines; line (i, j) is at the integers
    crossing = _segment_crossings if dimension == 2 else _triangle_crossings
    counts = tuple(reversed(grid.shape[1:]))
    line, height, sign = crossing(place, vertices[:, -1], faces, counts)
    # A crossing concerns the nodes below it: count it at the highest of them and sum down the line.
    level = np.ceil((height - grid.origin[-1]) / grid.spacing[-1]).astype(np.int64) - 1
    hit = level >= 0
    level = np.minimum(level, grid.shape[0] - 1)
    lines = int(np.prod(counts))
    total = np.bincount(level[hit] * lines + line[hit], weights=sign[hit], minlength=grid.size)
    jumps = np.rint(total).astype(np.int32).reshape(grid.shape)
    return np.cumsum(jumps[::-1], axis=0, dtype=np.int32)[::-1]


def _segment_crossings(
    place: np.ndarray, height: np.ndarray, faces: np.ndarray, counts: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid lines crossed by each segment: line number, height, sign (+1 where the line leaves the inside)."""
    start, end = place[faces[:, 0], 0], place[faces[:, 1], 0]
    first = np.maximum(np.ceil(np.minimum(start, end)), 0).astype(np.int64)
    stop = np.minimum(np.ceil(np.maximum(start, end)), counts[0]).astype(np.int64)
    segment, line = _ranges(first, stop)
    fraction = (line - start[segment]) / (end - start)[segment]
    h0, h1 = height[faces[segment, 0]], height[faces[segment, 1]]
    # Counter-clockwise around the inside, an upper side runs towards -x: there the line leaves the inside.
    return line, h0 + fraction * (h1 - h0), np.sign(start - end)[segment]


def _triangle_crossings(
    place: np.ndarray, height: np.ndarray, faces: np.ndarray, counts: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid lines that pierce each triangle: flat line number, height, sign (+1 leaving the inside)."""
    corner = place[faces]
    lower = np.maximum(np.ceil(corner.min(1)), 0).astype(np.int64)
    upper = np.minimum(np.floor(corner.max(1)) + 1, counts).astype(np.int64)
    strip, j = _ranges(lower[:, 1], upper[:, 1])
    row, i = _ranges(lower[strip, 0], upper[strip, 0])
    triangle, j = strip[row], j[row]
    at = np.stack([i, j], axis=-1).astype(np.float64)
    weight = np.stack([_edge(place, faces[triangle, (k + 1) % 3], faces[triangle, (k + 2) % 3], at) for k in range(3)])
    positive = (weight > 0).sum(0)
    pierced = (positive == 3) | (positive == 0)
    weight, triangle = weight[:, pierced], triangle[pierced]
    area = weight.sum(0)
    z = (weight * height[faces[triangle]].T).sum(0) / area
    return (i + counts[0] * j)[pierced], z, np.sign(area)


def _edge(place: np.ndarray, a: np.ndarray, b: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Twice the signed area of (a, b, at), evaluated with the smaller vertex first.

    The two triangles that share an edge then get the same number with opposite sign, bit for bit, so that a
    line that passes close to the edge, or through it, is counted by exactly one of them.
    """
    flip = a > b
    p, q = place[np.where(flip, b, a)], place[np.where(flip, a, b)]
    value = (q[:, 0] - p[:, 0]) * (at[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (at[:, 0] - p[:, 0])
    value[value == 0] = 1e-300  # on the edge: to the left of it, seen from the smaller vertex
    return np.where(flip, -value, value)


def _ranges(first: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All integers of many ranges [first, stop), with the number of the range each belongs to."""
    count = np.maximum(stop - first, 0)
    owner = np.repeat(np.arange(len(count)), count)
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return owner, first[owner] + offset
