"""The closest point of a surface, exactly: a k-d tree of its vertices proposes faces, the faces decide.

The closest surface point p of x lies inside a face, inside an edge or on a vertex, and x - p is orthogonal to
that part. One of the part's own vertices v is within the cover radius h = (longest edge) / sqrt(3) of p (Jung
1901), hence |x - v|^2 <= |x - p|^2 + h^2. A search of the nearest k vertices has therefore met the closest
face as soon as the k-th of them is farther away than that; else k grows. Faces longer than the others get
further vertices, for the search only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from geometry.arguments import ENDLESS, checked, finite

from .search_points import repeated, search_points
from .surface import Surface

FIRST_LOOK = 8  # vertices per point at first; measured: 4 and 12 are 10 to 20 % slower
LAST_LOOK = 1536  # where more are equally near, as at the centre of a sphere, h^2 / (2 distance) bounds the error
CHUNK = 16_384  # points at a time, so that the scratch arrays stay in the processor's cache


class Closest(NamedTuple):
    """The closest surface points: distance (m) `(n,)`, face `(n,)` and weights of its corners `(n, D)`."""

    distance: np.ndarray
    face: np.ndarray
    weights: np.ndarray

    @checked
    def point(self, surface: Surface) -> np.ndarray:
        """The closest points `(n, D)`, m."""
        return self.interpolate(surface, surface.vertices)

    @checked(values=finite())
    def interpolate(self, surface: Surface, values: np.ndarray) -> np.ndarray:
        """Values at the vertices `(nv, C)`, linear in the face, at the closest points: `(n, C)`."""
        return np.einsum("nk,nkc->nc", self.weights, values[surface.faces[self.face]])


class SurfaceIndex:
    """A surface prepared for closest-point queries.

    `resolution` (m) is a length of interest, such as the spacing of the grid that is asked for: faces much
    larger than it are given further search points. It changes the cost, not the result.
    """

    @checked(resolution=ENDLESS)
    def __init__(self, surface: Surface, resolution: float | None = None) -> None:
        self.surface = surface
        corner = surface.vertices[surface.faces]
        self._faces = _FaceTable(corner)
        longest = np.sqrt(((corner - np.roll(corner, 1, axis=1)) ** 2).sum(2)).max(1)
        step = 1.4 * float(longest.mean())
        search = search_points(surface, longest, step if resolution is None else min(step, 3 * resolution))
        self.points, self.cover_radius = search.points, search.cover_radius
        self._first, self._owners = search.first, search.owners
        self._tree = cKDTree(search.points, leafsize=12)

    @checked
    def query(self, points: np.ndarray) -> Closest:
        """The closest surface point of each of the points (n, D), m.

        Raises:
            ValueError: points that are not finite or of the wrong shape.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != self.surface.dimension or not np.isfinite(points).all():
            shape = f"(n, {self.surface.dimension})"
            raise ValueError(f"SurfaceIndex: points must be finite and {shape}, not {points.shape}")
        face = np.empty(len(points), np.int64)
        weights = np.empty((len(points), self.surface.dimension))
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            face[part], weights[part] = self._search(points[part])
        return self._result(points, face, weights)

    @checked(points=finite())
    def on_faces(self, points: np.ndarray, face: np.ndarray) -> Closest:
        """The closest point of the given `face (n,)` to each of `points (n, D)`, m."""
        return self._result(points, face, self._faces.closest(points, face)[1])

    def _result(self, points: np.ndarray, face: np.ndarray, weights: np.ndarray) -> Closest:
        # Measured afresh from the point itself: the search compares squares, which lose digits when small.
        where = np.einsum("nk,nkd->nd", weights, self.surface.vertices[self.surface.faces[face]])
        return Closest(np.sqrt(((points - where) ** 2).sum(1)), face, weights)

    def _search(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        state = np.full(len(points), np.inf), np.zeros(len(points), np.int64), np.zeros(points.shape)
        todo, look, most = np.arange(len(points)), FIRST_LOOK, len(self._first) - 1
        while len(todo):
            look = min(look, most)
            found = self._tree.query(points[todo], k=look)
            reach, vertex = found[0].reshape(-1, look) ** 2, found[1].reshape(-1, look)
            self._improve(points, todo, vertex, reach <= reach[:, :1] + self.cover_radius**2, state)
            if look >= min(LAST_LOOK, most):
                break
            todo = todo[reach[:, -1] <= state[0][todo] + self.cover_radius**2]
            look *= 4
        return state[1], state[2]

    def _improve(
        self,
        points: np.ndarray,
        todo: np.ndarray,
        vertex: np.ndarray,
        needed: np.ndarray,
        state: tuple[np.ndarray, np.ndarray, np.ndarray],
    ) -> None:
        """Try the faces around vertices `(len(todo), k)` where needed and keep what is closer, in place."""
        best, face, weights = state
        row, column = np.nonzero(needed)
        around = vertex[row, column]
        number, place = repeated(self._first[around + 1] - self._first[around])
        # Neighbouring vertices share faces: try each face once.
        pair = row[number] * len(self.surface.faces) + self._owners[self._first[around[number]] + place]
        pair.sort()
        row, candidate = np.divmod(pair[np.flatnonzero(np.diff(pair, prepend=-1))], len(self.surface.faces))
        square, trial = self._faces.closest(points[todo[row]], candidate)
        first = np.flatnonzero(np.diff(row, prepend=-1))
        least = np.minimum.reduceat(square, first)
        place = np.flatnonzero(square == np.repeat(least, np.diff(first, append=len(row))))
        place = place[np.diff(row[place], prepend=-1) > 0]  # of equally close faces the first
        closer = least < best[todo[row[place]]]
        rows, place = todo[row[place[closer]]], place[closer]
        best[rows], face[rows], weights[rows] = square[place], candidate[place], trial[place]


class _FaceTable:
    """The exact closest point of triangles or segments; what depends on the face alone is computed once."""

    def __init__(self, corner: np.ndarray) -> None:
        self.origin = corner[:, 0]
        self.e0 = corner[:, 1] - corner[:, 0]
        self.e1 = corner[:, -1] - corner[:, 0]
        a, b, c = ((u * v).sum(1) for u, v in ((self.e0, self.e0), (self.e0, self.e1), (self.e1, self.e1)))
        tiny = np.finfo(np.float64).tiny  # faces without area or edges without length divide 0 by it
        self.gram = np.stack([a, b, c, 1 / np.maximum(a, tiny), 1 / np.maximum(c, tiny)], axis=1)
        opposite, area = a - 2 * b + c, a * c - b * b
        self.scale = np.stack([1 / np.maximum(opposite, tiny), 1 / np.maximum(area, tiny)], axis=1)

    def closest(self, points: np.ndarray, face: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squared distance `(n,)` and corner weights `(n, D)`."""
        offset = points - self.origin[face]
        along = np.einsum("nd,nd->n", offset, self.e0[face])
        square = np.einsum("nd,nd->n", offset, offset)
        gram = self.gram[face].T
        if points.shape[1] == 2:
            s = np.clip(along * gram[3], 0, 1)
            return np.maximum(square + s * (gram[0] * s - 2 * along), 0), np.stack([1 - s, s], axis=1)
        across = np.einsum("nd,nd->n", offset, self.e1[face])
        return self._triangle(square, along, across, gram, self.scale[face].T)

    @staticmethod
    def _triangle(
        square: np.ndarray, along: np.ndarray, across: np.ndarray, gram: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Minimise |offset - s e0 - t e1|^2: the foot of the normal if inside, else a point of an edge."""
        a, b, c, over_a, over_c = gram
        s = (c * along - b * across) * scale[1]
        t = (a * across - b * along) * scale[1]
        inside = (s >= 0) & (t >= 0) & (s + t <= 1)
        s0 = np.clip(along * over_a, 0, 1)
        t1 = np.clip(across * over_c, 0, 1)
        t2 = np.clip((across - along + a - b) * scale[0], 0, 1)
        s2 = 1 - t2
        q0 = s0 * (a * s0 - 2 * along)
        q1 = t1 * (c * t1 - 2 * across)
        q2 = s2 * (a * s2 + 2 * b * t2 - 2 * along) + t2 * (c * t2 - 2 * across)
        first = (q0 <= q1) & (q0 <= q2)
        second = ~first & (q1 <= q2)
        s = np.where(inside, s, np.where(first, s0, np.where(second, 0.0, s2)))
        t = np.where(inside, t, np.where(first, 0.0, np.where(second, t1, t2)))
        value = square + s * (a * s + 2 * b * t - 2 * along) + t * (c * t - 2 * across)
        return np.maximum(value, 0), np.stack([1 - s - t, s, t], axis=1)
