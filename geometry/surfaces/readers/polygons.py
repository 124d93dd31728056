"""The polygons of a file, cut into triangles that keep what was said of each polygon."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


class PolygonError(ValueError):
    """A file of polygons that breaks its own format."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """Vertices and faces of three or more corners, as a file holds them.

    Attributes:
        vertices: (nv, 3), in the file's unit.
        corners: (nc,), vertex numbers of all polygons, one polygon after the other.
        sizes: (np,), number of corners of each polygon, at least 3.
        region: (np,), label of each polygon, or None where the file has none.
        names: name of the body that each polygon belongs to, or None.
    """

    vertices: np.ndarray
    corners: np.ndarray
    sizes: np.ndarray
    region: np.ndarray | None = None
    names: Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.sizes.size and self.sizes.min() < 3:
            raise PolygonError(f"face {int(self.sizes.argmin())} has fewer than three corners")
        if self.corners.size and not (self.corners.min() >= 0 and self.corners.max() < len(self.vertices)):
            bad = int(self.corners.min() if self.corners.min() < 0 else self.corners.max())
            raise PolygonError(f"a face uses vertex number {bad} of {len(self.vertices)} (counted from 0)")

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles (nt, 3) of vertex numbers, and (nt,) the polygon that each is cut from.

        A quadrilateral is cut along the shorter diagonal that lies inside it; longer polygons are fans around
        their first corner.
        """
        start = np.cumsum(self.sizes) - self.sizes
        owner = np.repeat(np.arange(len(self.sizes)), self.sizes - 2)
        place = np.arange(len(owner)) - np.repeat(np.cumsum(self.sizes - 2) - (self.sizes - 2), self.sizes - 2)
        first = np.where(self.sizes == 4, self._quad_start(start), 0)[owner]
        base, size = start[owner], self.sizes[owner]
        steps = [first, first + place + 1, first + place + 2]
        return np.stack([self.corners[base + step % size] for step in steps], axis=1), owner

    def _quad_start(self, start: np.ndarray) -> np.ndarray:
        """0 where a quadrilateral is cut from its first to its third corner, 1 where across."""
        cut = np.zeros(len(self.sizes), np.int64)
        quads = np.flatnonzero(self.sizes == 4)
        corner = self.vertices[self.corners[start[quads][:, None] + np.arange(4)]]
        diagonal = [np.linalg.norm(corner[:, k + 2] - corner[:, k], axis=1) for k in (0, 1)]
        lies_inside = [self._diagonal_inside(corner, k) for k in (0, 1)]
        shorter = diagonal[1] < diagonal[0] * (1 - 1e-9)
        cut[quads] = np.where(lies_inside[0] == lies_inside[1], shorter, lies_inside[1])
        return cut

    @staticmethod
    def _diagonal_inside(corner: np.ndarray, k: int) -> np.ndarray:
        """Whether both triangles beside the diagonal from corner k face the same way."""
        a, b, c, d = (corner[:, (k + step) % 4] for step in range(4))
        return (np.cross(b - a, c - a) * np.cross(c - a, d - a)).sum(1) > 0
