"""Holes closed along themselves: a fan where the rim is star-shaped, else the triangulation of least area."""

from __future__ import annotations

import numpy as np

from .surface import SurfaceError

LONGEST_RIM = 600  # vertices; the search for the least area takes memory and time with their square and cube
SHAPE = 1e-6  # weight of an edge's squared length beside the area: of equal areas the compacter triangles win


def star_shaped(rim: np.ndarray) -> bool:
    """Whether a fan around the middle of a rim `(n, 3)` covers its hole once, without a fold."""
    spoke = rim - rim.mean(axis=0)
    fans = np.cross(spoke, np.roll(spoke, -1, axis=0))
    return bool((fans @ fans.sum(axis=0) > 0).all())


def least_area_triangles(rim: np.ndarray) -> np.ndarray:
    """Triangles between the vertices of a closed rim, of the least total area.

    Dynamic programming over the rim's arcs (Barequet and Sharir 1995, "Filling gaps in the boundary of a
    polyhedron", sec. 4). In a plane it is a triangulation of the polygon, however it bends: all others leave
    it and are larger.

    Args:
        rim: (n, 3), n >= 3, the vertices in order.

    Returns:
        (n - 2, 3), numbers of the rim's vertices, in the sense of the rim.

    Raises:
        SurfaceError: the rim has too many vertices.
    """
    count = len(rim)
    if count > LONGEST_RIM:
        raise SurfaceError(
            f"a hole whose rim bends in on itself has {count} vertices, more than the {LONGEST_RIM} that are closed "
            "along themselves; close it in the program that made the surface"
        )
    cost = np.zeros((count, count))
    split = np.zeros((count, count), np.int64)
    for gap in range(2, count):
        first = np.arange(count - gap)
        last = first + gap
        middle = first[:, None] + np.arange(1, gap)
        a, b, c = rim[first][:, None], rim[middle], rim[last][:, None]
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=2)
        shape = SHAPE * (((b - a) ** 2).sum(2) + ((c - b) ** 2).sum(2) + ((c - a) ** 2).sum(2))
        total = cost[first[:, None], middle] + cost[middle, last[:, None]] + area + shape
        best = total.argmin(axis=1)
        cost[first, last] = total[first, best]
        split[first, last] = middle[first, best]
    triangles, todo = [], [(0, count - 1)]
    while todo:
        i, j = todo.pop()
        if j - i < 2:
            continue
        k = int(split[i, j])
        triangles.append((i, k, j))
        todo += [(i, k), (k, j)]
    return np.array(triangles, np.int64)
