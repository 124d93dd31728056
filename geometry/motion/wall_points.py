"""Points evenly on a moving wall, for equations there: position, outward normal, velocity, area, region.

A triangulation has few points where the wall is flat and many where it is finely meshed (Grønli 2017,
sec. 5.1). Here large faces are cut and small ones gathered until there is about one point per `spacing`^2 (per
`spacing` in a plane). The points are chosen once and then travel with the wall.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array

from geometry.arguments import Rule, between, checked
from geometry.surfaces.search_points import repeated, sub_triangles
from geometry.surfaces.surface import Surface, unit

from .wall_motion import WallMotion

MOST_POINTS = 50_000_000  # of a wall; a spacing that asks for more is a mistake of units


class WallPoints(NamedTuple):
    """Points (m), normals out of the blood, velocities (m/s), all `(n, D)`, areas (m^2), region `(n,)`."""

    points: np.ndarray
    normals: np.ndarray
    velocities: np.ndarray
    areas: np.ndarray
    region: np.ndarray


class WallSampler:
    """Points about `spacing` (m) apart on a moving wall.

    The areas add up to the area of the wall; with `smooth_angle=0` and faces larger than the spacing the sum of
    area * normal . velocity is dV/dt to round-off.

    Args:
        motion: of the wall.
        spacing: m, between points.
        smooth_angle: degrees. Normals are interpolated between the corners of a face, and a corner's normal is the
            angle-weighted mean over the faces around it whose normals differ by less than this from the face's own, so
            that curves are smooth and the rim of a base stays sharp; 0 gives the normals of the faces.

    Raises:
        ValueError: a spacing or angle out of range.
    """

    @checked(
        spacing=between(1e-100, 1e100), smooth_angle=Rule("0 or more and less than 90", lambda value: 0 <= value < 90)
    )
    def __init__(self, motion: WallMotion, spacing: float, *, smooth_angle: float = 40.0) -> None:
        self.motion = motion
        surface = motion.surface(float(motion.time[0]))
        if not surface.area / MOST_POINTS < spacing ** (surface.dimension - 1) < math.inf:
            raise ValueError(f"WallSampler: spacing {spacing:g} m asks for more than {MOST_POINTS} points: is it in m?")
        owner, weights = _cut(surface, spacing)
        group = _gather(surface, owner, weights, spacing)
        count, faces = int(group.max()) + 1, len(surface.faces)
        share = 1 / np.bincount(owner)[owner]
        area = share * surface.areas[owner]
        total, pieces = np.bincount(group, weights=area)[group], np.bincount(group)[group]
        # faces without any area, as where a cut passes through a vertex, stay places with a mean over their corners
        part = np.divide(area, total, out=1.0 / pieces, where=total > 0)
        mean = part[:, None] * weights
        rows = np.repeat(group, surface.dimension)
        # Points and velocities are means over vertices, area vectors sums over faces: linear maps, made once.
        self._mean = _sparse(mean, rows, surface.faces[owner], (count, len(surface.vertices)))
        self._sum = _sparse(share, group, owner, (count, faces))
        self._corners = self._blend = None
        if smooth_angle > 0:
            corner = owner[:, None] * surface.dimension + np.arange(surface.dimension)
            self._corners = _sparse(mean, rows, corner, (count, faces * surface.dimension))
            self._blend = _corner_blend(surface, float(np.cos(np.radians(smooth_angle))))
        self.region = surface.region[owner[np.unique(group, return_index=True)[1]]]

    def __len__(self) -> int:
        return len(self.region)

    @checked
    def at(self, t: float) -> WallPoints:
        """The points at time `t` (s)."""
        surface = self.motion.surface(t)
        if self._blend is None:
            normals = unit(self._sum @ surface.area_vectors)
        else:
            normals = unit(self._corners @ unit(self._blend @ surface.normals))
        points, velocities = self._mean @ surface.vertices, self._mean @ self.motion.velocity(t)
        return WallPoints(points, normals, velocities, self._sum @ surface.areas, self.region)


@checked
def wall_points(motion: WallMotion, t: float, spacing: float, *, smooth_angle: float = 40.0) -> WallPoints:
    """Points about `spacing` (m) apart on the wall at time `t` (s); for many times keep a `WallSampler`."""
    return WallSampler(motion, spacing, smooth_angle=smooth_angle).at(t)


def _cut(surface: Surface, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut faces longer than the spacing: the face of each piece and its centroid's weights of the corners."""
    corner = surface.vertices[surface.faces]
    if surface.dimension == 2:
        pieces = np.maximum(np.rint(surface.areas / spacing), 1).astype(np.int64)
        owner, number = repeated(pieces)
        place = (number + 0.5) / pieces[owner]
        return owner, np.stack([1 - place, place], axis=1)
    sides = np.stack([corner[:, (k + 1) % 3] - corner[:, k] for k in range(3)], axis=1)
    # With 1.8 spacings on the longest side no place is farther than a spacing from a centroid.
    cuts = np.maximum(np.ceil(np.sqrt((sides**2).sum(2)).max(1) / (1.8 * spacing) - 0.1), 1).astype(np.int64)
    owners, weights = [], []
    for n in np.unique(cuts):
        faces, piece = np.flatnonzero(cuts == n), sub_triangles(int(n))
        owners.append(np.repeat(faces, n * n))
        weights.append(np.tile(piece, (len(faces), 1)))
    return np.concatenate(owners), np.concatenate(weights)


def _gather(surface: Surface, owner: np.ndarray, weights: np.ndarray, spacing: float) -> np.ndarray:
    """Group pieces much smaller than the spacing by box, region and direction of the normal: `(pieces,)`."""
    where = np.einsum("nk,nkd->nd", weights, surface.vertices[surface.faces[owner]])
    size = (surface.areas / np.bincount(owner, minlength=len(surface.faces)))[owner]
    small = size < 0.4 * spacing ** (surface.dimension - 1)
    box = np.floor((where - where.min(axis=0)) / spacing).astype(np.int64)
    # Which axis the normal follows most, and in which sense: faces around a sharp edge must not be mixed.
    normal = surface.normals[owner]
    axis = np.abs(normal).argmax(axis=1)
    facing = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    single = np.where(small, -1, np.arange(len(owner)))
    key = np.column_stack([np.where(small[:, None], box, 0), facing, surface.region[owner], single])
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(-1)


def _corner_blend(surface: Surface, cosine: float) -> csr_array:
    """The map `(nf * D, nf)` from normals of faces to normals of corners, over faces at a small angle."""
    dimension, count = surface.dimension, len(surface.faces)
    vertex = surface.faces.ravel()
    order = np.argsort(vertex, kind="stable")
    around = np.bincount(vertex, minlength=len(surface.vertices))
    first = np.cumsum(around) - around
    corner, place = repeated(around[vertex])
    other = order[first[vertex[corner]] + place]
    face, neighbour = corner // dimension, other // dimension
    close = (surface.normals[face] * surface.normals[neighbour]).sum(axis=1) > cosine
    close |= face == neighbour
    angle = np.stack(surface.corner_angles(), axis=1).ravel()[other]
    return _sparse(angle[close], corner[close], neighbour[close], (count * dimension, count))


def _sparse(values: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> csr_array:
    return csr_array(coo_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape))
