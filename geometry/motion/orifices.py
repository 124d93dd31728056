"""Orifices: the faces of a region label above 0 as a plane opening that moves with the wall.

The plane is the one through the faces' centroid across their total area vector. That vector depends on the
rim alone (Stokes), so that a bulging or ragged set of faces has the same opening as a flat one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from geometry.arguments import checked
from geometry.surfaces.repair import rims
from geometry.surfaces.surface import SurfaceError, pieces_of

from .wall_motion import WallMotion


@dataclass(frozen=True, eq=False)
class OrificePlane:
    """An opening at one time: `centroid` (D,) m, `normal` (D,) out of the blood, `area` m^2 (in a plane m).

    `basis` (D - 1, D): orthonormal directions in the opening, the first towards the first rim point, which
    carries them along as the wall moves. `rim` (m, D), m: its rim, as pairs of ends `(m, 2)` in `edges`,
    counter-clockwise seen from outside.
    """

    centroid: np.ndarray
    normal: np.ndarray
    area: float
    basis: np.ndarray
    rim: np.ndarray
    edges: np.ndarray

    @cached_property
    def outline(self) -> np.ndarray:
        """The rim in the coordinates of `basis`, `(m, D - 1)`, m."""
        return (self.rim - self.centroid) @ self.basis.T

    @checked
    def height(self, points: Tensor) -> Tensor:
        """Distance (m) of points `(n, D)` from the plane, `(n,)`: positive outwards, out of the blood."""
        return (points - points.new_tensor(self.centroid)) @ points.new_tensor(self.normal)

    @checked
    def lateral(self, points: Tensor) -> Tensor:
        """Points `(n, D)` in the coordinates of `basis`: `(n, D - 1)`, m."""
        return (points - points.new_tensor(self.centroid)) @ points.new_tensor(self.basis).T

    @checked
    def lateral_distance(self, points: Tensor) -> Tensor:
        """In-plane distance (m) of points `(n, D)` to the rim, `(n,)`: positive over the opening only.

        Exact for the polygon. Cost is points times rim edges; narrow the points down by `height` first where
        many lie far away.
        """
        return rim_distance(self.lateral(points), points.new_tensor(self.outline), torch.from_numpy(self.edges))


@dataclass(frozen=True, eq=False)
class Orifice:
    """One connected opening of a moving wall: region `label` (1 mitral, 2 aortic, ...) and its `faces`."""

    motion: WallMotion
    label: int
    faces: np.ndarray
    _edges: np.ndarray = field(repr=False)
    _memory: dict[float, OrificePlane] = field(default_factory=dict, repr=False)

    @checked
    def at(self, t: float) -> OrificePlane:
        """The opening at time `t` (s); the last one asked for is remembered."""
        if t not in self._memory:
            plane = self._fit(t)
            self._memory.clear()
            self._memory[t] = plane
        return self._memory[t]

    def centroid(self, t: float) -> np.ndarray:
        """Middle of the opening, `(D,)`, m."""
        return self.at(t).centroid

    def normal(self, t: float) -> np.ndarray:
        """Unit normal out of the blood, `(D,)`."""
        return self.at(t).normal

    def area(self, t: float) -> float:
        """Area of the opening, m^2 (length, m, in a plane)."""
        return self.at(t).area

    def rim(self, t: float) -> np.ndarray:
        """Rim points `(m, D)`, m, in order around the opening (with inner rims after the outer one)."""
        return self.at(t).rim

    @checked
    def height(self, points: Tensor, t: float) -> Tensor:
        """Distance (m) of points `(n, D)` outwards from the plane of the opening, `(n,)`."""
        return self.at(t).height(points)

    @checked
    def lateral_distance(self, points: Tensor, t: float) -> Tensor:
        """In-plane distance (m) of points `(n, D)` to the rim, `(n,)`, positive over the opening."""
        return self.at(t).lateral_distance(points)

    def velocity(self, t: float) -> np.ndarray:
        """Mean velocity of the opening's faces, `(D,)`, m/s."""
        surface, speed = self.motion.surface(t), self.motion.velocity(t)
        share = surface.areas[self.faces]
        return (speed[self.motion.faces[self.faces]].mean(axis=1) * share[:, None]).sum(axis=0) / share.sum()

    def _fit(self, t: float) -> OrificePlane:
        surface = self.motion.surface(t)
        vector, share = surface.area_vectors[self.faces].sum(axis=0), surface.areas[self.faces]
        area = float(np.linalg.norm(vector))
        if not area > 1e-12 * float(share.sum()):
            raise SurfaceError(f"region {self.label} encloses no opening at {t:g} s: its area vectors cancel")
        normal = vector / area
        centroid = (surface.centroids[self.faces] * share[:, None]).sum(axis=0) / share.sum()
        order = self._edges[:, 0]
        rim = surface.vertices[order]
        first = rim[0] - centroid
        first = first - (first @ normal) * normal
        if self.motion.dimension == 2 or not np.linalg.norm(first) > 0:
            first = np.array([-normal[1], normal[0], *([0.0] * (self.motion.dimension - 2))])
        first = first / np.linalg.norm(first)
        basis = first[None] if self.motion.dimension == 2 else np.stack([first, np.cross(normal, first)])
        number = {vertex: place for place, vertex in enumerate(order.tolist())}
        pairs = np.array([[number[a], number[b]] for a, b in self._edges.tolist()])
        return OrificePlane(centroid, normal, area, basis, rim, pairs)


@checked
def orifices(motion: WallMotion) -> list[Orifice]:
    """The openings of a moving wall: one for each connected set of faces of a region above 0, by label.

    Raises:
        SurfaceError: a region covers the whole surface and so has no rim.
    """
    found = []
    for label in np.unique(motion.region[motion.region > 0]):
        faces = np.flatnonzero(motion.region == label)
        piece = pieces_of(motion.faces[faces], motion.vertices_at_keys.shape[1])
        for number in range(piece.max() + 1):
            part = faces[piece == number]
            found.append(Orifice(motion, int(label), part, _rim_edges(motion.faces[part], int(label))))
    return found


_CURE = "label the faces of each opening alone, and those of the wall itself 0"


def _rim_edges(faces: np.ndarray, label: int) -> np.ndarray:
    """Directed edges around a set of faces, in order (in a plane both ends, each as a pair with itself)."""
    if faces.shape[1] == 2:
        ends = np.setxor1d(faces[:, 0], faces[:, 1])
        if len(ends) != 2:
            rule = f"region {label} has {len(ends)} ends in the plane, but an opening has two"
            raise SurfaceError(f"/wall/region: {rule}; {_CURE}")
        return np.stack([ends, ends], axis=1)
    loops = rims(faces)
    if not loops:
        raise SurfaceError(f"/wall/region: region {label} has no rim, because it covers a closed surface; {_CURE}")
    return np.concatenate([np.column_stack([loop, np.roll(loop, -1)]) for loop in loops])


def rim_distance(place: Tensor, outline: Tensor, edges: Tensor) -> Tensor:
    """Distance of points `(n, D - 1)` in an opening to its rim, `(n,)`, positive inside: see `OrificePlane`."""
    if place.shape[1] == 1:
        return torch.minimum(place[:, 0] - outline.min(), outline.max() - place[:, 0])
    start, end = outline[edges.T.to(outline.device)]
    return _polygon_distance(place, start, end)


def _polygon_distance(place: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Signed distance of points `(n, 2)` to edges from `(m, 2)` to `(m, 2)`, positive inside (even-odd)."""
    # by components: sums over an axis of two would take most of the time
    (ax, ay), (x, y) = (end - start).unbind(1), (place[:, None] - start).unbind(2)
    square = (ax * ax + ay * ay).clamp(min=torch.finfo(place.dtype).tiny)
    share = ((x * ax + y * ay) / square).clamp(0, 1)
    distance = ((x - share * ax).square() + (y - share * ay).square()).amin(1).sqrt()
    above = y >= 0
    crosses = above != (place[:, None, 1] - end[:, 1] >= 0)
    left = ax * y - ay * x > 0
    # A ray towards +x crosses an edge that goes up with the point to its left, or down with it to its right.
    inside = (crosses & (left != above)).sum(dim=1) % 2 == 1
    return torch.where(inside, distance, -distance)
