"""A closed surface around the blood: triangles in space, or the edges of closed polylines in a plane.

Faces are numbered so that their normals point outwards, away from the blood (counter-clockwise around it in a
plane).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geometry.arguments import checked

from .integers import narrowed
from .winding import winding_number

if TYPE_CHECKING:
    import trimesh


class SurfaceError(ValueError):
    """A surface that cannot bound a domain: malformed, open or inside out."""


@checked
@dataclass(frozen=True, eq=False)
class Surface:
    """Faces between vertices, in space (D = 3) or in a plane (D = 2).

    Closedness and orientation are not required to build one: `check` does that, `repaired` (see `repair`) mends.

    Args:
        vertices: (nv, D), m.
        faces: (nf, D), vertex numbers.
        region: (nf,), labels: 0 wall, 1 mitral inlet, 2 aortic outlet, further ones free; None: all 0.

    Raises:
        SurfaceError: shapes that do not fit, vertices that are not finite, face indices out of range.
    """

    vertices: np.ndarray
    faces: np.ndarray
    region: np.ndarray = None  # type: ignore[assignment]  # an array once built

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(_narrowed("faces", self.faces, np.int32))
        region = np.zeros(len(faces), np.uint8)
        if self.region is not None:
            region = np.ascontiguousarray(_narrowed("region", self.region, np.uint8))
        if vertices.ndim != 2 or vertices.shape[1] not in (2, 3):
            raise SurfaceError(f"vertices must be (nv, 2) or (nv, 3), not {vertices.shape}")
        if faces.ndim != 2 or faces.shape[1] != vertices.shape[1] or len(faces) == 0:
            raise SurfaceError(f"faces must be (nf, {vertices.shape[1]}) with at least one face, not {faces.shape}")
        if region.shape != (len(faces),):
            raise SurfaceError(f"region must hold one label for each of the {len(faces)} faces, not {region.shape}")
        if not np.isfinite(vertices).all():
            raise SurfaceError("vertices must be finite (metres)")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise SurfaceError(
                f"faces must number vertices 0 to {len(vertices) - 1}, not {faces.min()} to {faces.max()}"
            )
        for name, value in (("vertices", vertices), ("faces", faces), ("region", region)):
            object.__setattr__(self, name, value)

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.vertices.shape[1]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (m) of the box around the vertices that faces use."""
        used = self.vertices[np.unique(self.faces)]
        return used.min(0), used.max(0)

    @cached_property
    def area_vectors(self) -> np.ndarray:
        """Outward normal times area of each face, `(nf, D)`, m^2 (times length, m, in a plane)."""
        corner = self.vertices[self.faces]
        along = corner[:, 1] - corner[:, 0]
        if self.dimension == 2:
            return np.stack([along[:, 1], -along[:, 0]], axis=1)
        return 0.5 * np.cross(along, corner[:, 2] - corner[:, 0])

    @cached_property
    def areas(self) -> np.ndarray:
        """Area of each face, `(nf,)`, m^2 (length, m, in a plane)."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @property
    def area(self) -> float:
        """Area of the whole surface, m^2 (length, m, in a plane)."""
        return float(self.areas.sum())

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normal of each face, `(nf, D)`; zero for a face without area."""
        return unit(self.area_vectors)

    @property
    def centroids(self) -> np.ndarray:
        """Centroid of each face, `(nf, D)`, m."""
        return self.vertices[self.faces].mean(1)

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """Outward unit normals at the vertices, `(nv, D)`: face normals weighted by the angle at the vertex.

        Independent of how the faces around a vertex are cut (Thuermer and Wuethrich 1998). Zero at unused
        vertices.
        """
        total = np.zeros_like(self.vertices)
        for corner, angle in enumerate(self.corner_angles()):
            np.add.at(total, self.faces[:, corner], self.normals * angle[:, None])
        return unit(total)

    @cached_property
    def volume(self) -> float:
        """Enclosed volume, m^3 (area, m^2, in a plane); negative where the surface is inside out."""
        return float(self._volume_shares().sum())

    @cached_property
    def component_labels(self) -> np.ndarray:
        """Number of the connected piece that each face belongs to, `(nf,)`."""
        return pieces_of(self.faces, len(self.vertices))

    @property
    def component_volumes(self) -> np.ndarray:
        """Signed volume of each connected piece, m^3 (m^2 in a plane)."""
        return np.bincount(self.component_labels, weights=self._volume_shares())

    @cached_property
    def open_ridges(self) -> int:
        """Number of edges (vertices in a plane) that bound an odd number of faces: holes and seams."""
        return int((self._ridges()[1] % 2 != 0).sum())

    @cached_property
    def twisted_ridges(self) -> int:
        """Number of edges with an even number of faces that are not numbered in the same sense."""
        balance, count = self._ridges()
        return int(((balance != 0) & (count % 2 == 0)).sum())

    @property
    def is_closed(self) -> bool:
        """Whether every edge is passed equally often in both directions, so that a volume is enclosed."""
        return self.open_ridges == 0 and self.twisted_ridges == 0

    def check(self) -> None:
        """Raise SurfaceError unless the surface is closed, consistently numbered and outward everywhere."""
        ridges = "edges" if self.dimension == 3 else "vertices"
        cure = "; mend it with geometry.repaired"
        if self.open_ridges:
            text = f"the surface is not closed: {self.open_ridges} {ridges} bound a hole or an unmerged seam"
            raise SurfaceError(text + cure)
        if self.twisted_ridges:
            text = f"the surface is not closed consistently: faces beside {self.twisted_ridges} {ridges} "
            raise SurfaceError(text + "are numbered in opposite senses" + cure)
        wrong = self.reversed_components()
        if wrong.any():
            pieces = f"{int(wrong.sum())} of its {len(wrong)} pieces have" if len(wrong) > 1 else "it has"
            text = f"the surface is inside out: {pieces} normals that point into the blood"
            raise SurfaceError(text + cure)

    def reversed_components(self) -> np.ndarray:
        """Which connected pieces are inside out: all must be positive, but negative inside another one."""
        volumes, label = self.component_volumes, self.component_labels
        if len(volumes) == 1:
            return volumes <= 0
        first = self.vertices[self.faces[np.unique(label, return_index=True)[1], 0]]
        depth = np.zeros(len(volumes), int)
        for piece in range(len(volumes)):
            others = np.arange(len(volumes)) != piece
            winding = winding_number(self.vertices, self.faces[label == piece], first[others])
            depth[others] += np.abs(winding) > 0.5
        return np.where(depth % 2 == 0, volumes <= 0, volumes >= 0)

    def moved(self, vertices: np.ndarray) -> Surface:
        """The same faces and regions at other vertex positions `(nv, D)`, m."""
        result = replace(self, vertices=vertices)
        # What depends on the faces alone, and has been found out already, holds for the moved surface too.
        for name in ("component_labels", "open_ridges", "twisted_ridges"):
            if name in self.__dict__ and len(result.vertices) == len(self.vertices):
                result.__dict__[name] = self.__dict__[name]
        return result

    @checked
    def part(self, region: int) -> np.ndarray:
        """Numbers of the faces that carry a region label."""
        return np.flatnonzero(self.region == region)

    def trimesh(self) -> trimesh.Trimesh:
        """The same triangles as a trimesh object (3-D only), vertices in order, regions as face attribute."""
        import trimesh

        if self.dimension != 3:
            raise SurfaceError("a polyline has no trimesh form: it is two-dimensional")
        return trimesh.Trimesh(self.vertices, self.faces, face_attributes={"region": self.region}, process=False)

    def _volume_shares(self) -> np.ndarray:
        """Volume of the cone over each face, `(nf,)`, from a common tip."""
        # The tip is the middle of the vertices: far from the surface the terms would cancel badly.
        offset = self.vertices[self.faces[:, 0]] - self.vertices[self.faces.ravel()].mean(0)
        return (self.area_vectors * offset).sum(1) / self.dimension

    def _ridges(self) -> tuple[np.ndarray, np.ndarray]:
        """For each edge (vertex in a plane): passes forward minus backward, and all passes."""
        place, sign = ridges_of(self.faces, len(self.vertices))
        return np.bincount(place, weights=sign), np.bincount(place)

    def corner_angles(self) -> list[np.ndarray]:
        """Angle (rad) of every face at its first, second, third corner, `(nf,)` each; 1 in a plane."""
        if self.dimension == 2:
            return [np.ones(len(self.faces))] * 2
        corner = self.vertices[self.faces]
        result = []
        for k in range(3):
            a, b = unit(corner[:, (k + 1) % 3] - corner[:, k]), unit(corner[:, (k + 2) % 3] - corner[:, k])
            result.append(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1)))
        return result


def pieces_of(faces: np.ndarray, count: int) -> np.ndarray:
    """Number of the connected piece of each face `(nf,)`; `count` vertices are numbered."""
    start = np.repeat(faces[:, 0], faces.shape[1] - 1)
    graph = coo_array((np.ones(len(start), np.int8), (start, faces[:, 1:].ravel())), shape=(count, count))
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.unique(label, return_inverse=True)[1]


def ridges_of(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The edges (vertices in a plane) of faces: the number of the edge, and +1 or -1 for its direction.

    Both `(D * nf,)`, first all faces' first sides, then their second ones; 0 for an edge from a vertex to
    itself, which bounds nothing.
    """
    if faces.shape[1] == 2:
        key = faces.T.ravel()
        sign = np.repeat([1, -1], len(faces))
    else:
        start, end = (faces[:, order].T.ravel().astype(np.int64) for order in ([0, 1, 2], [1, 2, 0]))
        key = np.minimum(start, end) * count + np.maximum(start, end)
        sign = np.sign(end - start)
    return np.unique(key, return_inverse=True)[1], sign


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors `(..., D)` divided by their length; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def _narrowed(name: str, values: object, kind: type) -> np.ndarray:
    try:
        return narrowed(values, kind)
    except ValueError as fault:
        raise SurfaceError(f"{name} {fault}") from fault
