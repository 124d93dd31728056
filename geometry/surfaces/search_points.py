"""Points of a surface to search by: its vertices, and more of them where faces are longer than a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .surface import Surface

MOST = 200_000


class SearchPoints(NamedTuple):
    """Points `(n, D)`, m; the faces around point i are `owners[first[i] : first[i + 1]]`.

    Each point of a vertex, an edge or a face has one of these on the same vertex, edge or face within
    `cover_radius` (m).
    """

    points: np.ndarray
    first: np.ndarray
    owners: np.ndarray
    cover_radius: float


def search_points(surface: Surface, longest: np.ndarray, step: float) -> SearchPoints:
    """Search points about `step` (m) apart on edges; `longest` (nf,) is the longest edge of each face."""
    large = longest > step
    # However coarse a mesh is, a search gains nothing from more points than this.
    step = max(step, float(np.sqrt((longest[large] ** 2).sum() / MOST)))
    # Powers of two, so that the points on an edge belong to the lattices of the faces on both of its sides.
    cuts = 2 ** np.ceil(np.log2(np.maximum(longest / step, 1))).astype(np.int64)
    used, place = np.unique(surface.faces, return_inverse=True)
    parts = [surface.vertices[used]]
    points, owners = [place.reshape(-1)], [np.repeat(np.arange(len(surface.faces)), surface.dimension)]
    total = len(used)
    for more, inside, faces in (_on_edges(surface, cuts), _in_faces(surface, cuts)):
        parts.append(more)
        points.append(inside + total)
        owners.append(faces)
        total += len(more)
    point, owner = np.concatenate(points), np.concatenate(owners)
    first = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=total))])
    radius = float((longest / cuts).max()) / np.sqrt(3)
    return SearchPoints(np.concatenate(parts), first, owner[np.argsort(point, kind="stable")], radius)


def _on_edges(surface: Surface, cuts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points inside the edges (in a plane, the faces) of faces that are cut, and pairs of point and face."""
    long = np.flatnonzero(cuts > 1)
    corner = surface.faces[long]
    if surface.dimension == 2:
        sides, faces = corner, long
    else:
        sides, faces = corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), np.repeat(long, 3)
    low, high = sides.min(axis=1).astype(np.int64), sides.max(axis=1)
    _, one, edge = np.unique(low * len(surface.vertices) + high, return_index=True, return_inverse=True)
    count = np.zeros(len(one), np.int64)
    np.maximum.at(count, edge, cuts[faces])
    row, number = repeated(count - 1)
    start, end = surface.vertices[low[one]], surface.vertices[high[one]]
    points = start[row] + ((number + 1) / count[row])[:, None] * (end - start)[row]
    # Each face passes on all points of its edges, also those that only its neighbour asked for.
    side, place = repeated((count - 1)[edge])
    begin = np.cumsum(count - 1) - (count - 1)
    return points, begin[edge[side]] + place, faces[side]


def _in_faces(surface: Surface, cuts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lattice points strictly inside faces, and pairs of point and face."""
    points, owners = [np.zeros((0, surface.dimension))], [np.zeros(0, np.int64)]
    for n in np.unique(cuts[cuts > 2]) if surface.dimension == 3 else ():
        faces = np.flatnonzero(cuts == n)
        i, j = (index.ravel() for index in np.meshgrid(np.arange(1, n), np.arange(1, n), indexing="ij"))
        i, j = i[i + j < n], j[i + j < n]
        weight = np.stack([n - i - j, i, j], axis=1) / n
        points.append(np.einsum("sk,fkd->fsd", weight, surface.vertices[surface.faces[faces]]).reshape(-1, 3))
        owners.append(np.repeat(faces, len(i)))
    owner = np.concatenate(owners)
    return np.concatenate(points), np.arange(len(owner)), owner


def sub_triangles(n: int) -> np.ndarray:
    """Corner weights of the centroids of the n^2 similar triangles that make up a triangle: `(n * n, 3)`."""
    i, j = (index.ravel() for index in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    upper = i + j >= n  # squares beyond the diagonal are folded back: triangles that point down
    u = np.where(upper, n - i - 1 / 3, i + 1 / 3) / n
    v = np.where(upper, n - j - 1 / 3, j + 1 / 3) / n
    return np.stack([1 - u - v, u, v], axis=1)


def repeated(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each i, count[i] rows: the i and the number of the row among them."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
