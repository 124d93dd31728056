"""The triangulation of the parametric ventricle: rings down the side, a Delaunay base that keeps the rims."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from geometry.surfaces.shapes import ellipse_rim, ring_of, stitched
from geometry.surfaces.surface import Surface, SurfaceError


class VentricleShape(Protocol):
    """What the mesh needs of a ventricle: a truncated spheroid with two orifices in its base plane, in m."""

    @property
    def length(self) -> float:
        """From base to apex."""

    @property
    def semi_major(self) -> float:
        """Of the spheroid, along z."""

    @property
    def semi_minor(self) -> float:
        """Of the spheroid, across."""

    @property
    def offset(self) -> float:
        """How far the spheroid's centre lies below the base."""

    @property
    def base_radius(self) -> float:
        """Radius of the base."""

    @property
    def mitral_centre(self) -> tuple[float, float]:
        """(x, y) in the base plane."""

    @property
    def mitral_semi_axes(self) -> tuple[float, float]:
        """Along x and y."""

    @property
    def aortic_centre(self) -> tuple[float, float]:
        """(x, y) in the base plane."""

    @property
    def aortic_radius(self) -> float:
        """Of the circular outlet."""

    def rims(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Points (count, 2) each on the mitral and the aortic rim."""


def ventricle_surface(shape: VentricleShape, spacing: float) -> Surface:
    """The end-diastolic surface, vertices about `spacing` (m) apart; SurfaceError if that is too coarse."""
    if not 0 < spacing <= 0.5 * shape.base_radius:
        raise SurfaceError(f"ventricle: spacing must be positive and below half the base radius, not {spacing} m")
    rings = _side(shape, spacing)
    base, base_faces, base_region = _base(shape, rings[0], spacing)
    first = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
    bands = [stitched(first[k], len(rings[k]), first[k + 1], len(rings[k + 1])) for k in range(len(rings) - 1)]
    side = np.concatenate(bands)
    # The base numbers the top ring first, as here, and its own points after it: these come after all rings.
    top = len(rings[0])
    base_faces = np.where(base_faces < top, base_faces, base_faces + first[-1] - top)
    vertices = np.concatenate([*rings, np.column_stack([base, np.zeros(len(base))])])
    faces = np.concatenate([side, base_faces])
    region = np.concatenate([np.zeros(len(side), np.uint8), base_region])
    return Surface(vertices, _outward(vertices, faces, np.array([0, 0, -shape.length / 3])), region)


def _side(shape: VentricleShape, spacing: float) -> list[np.ndarray]:
    """Rings from the base to the apex, evenly along the meridian."""
    angle = np.linspace(np.arccos(shape.offset / shape.semi_major), np.pi, 2001)
    radius, z = shape.semi_minor * np.sin(angle), shape.semi_major * np.cos(angle) - shape.offset
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(radius), np.diff(z)))])
    count = max(4, round(length[-1] / spacing))
    even = np.interp(np.linspace(0, length[-1], count + 1), length, angle)
    rings = [
        ring_of(shape.semi_minor * np.sin(a), shape.semi_major * np.cos(a) - shape.offset, spacing) for a in even[1:-1]
    ]
    return [ring_of(shape.base_radius, 0.0, spacing), *rings, np.array([[0.0, 0.0, -shape.length]])]


def _base(shape: VentricleShape, top: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The base's own points `(n, 2)`, its faces (the top ring is numbered first) and their regions."""
    mitral, aortic = (np.asarray(c) for c in (shape.mitral_centre, shape.aortic_centre))
    circle = (shape.aortic_radius, shape.aortic_radius)
    fine = [np.concatenate([rim, top[:, :2]]) for rim in shape.rims(256)]
    gap = min(cKDTree(fine[0]).query(shape.rims(256)[1])[0].min(), cKDTree(top[:, :2]).query(fine[1][:256])[0].min())
    # A rim edge longer than twice the gap to the next rim would not be a Delaunay edge.
    step = min(spacing, 1.5 * float(gap))
    rims = [mitral + ellipse_rim(shape.mitral_semi_axes, step), aortic + ellipse_rim(circle, step)]
    fixed = np.concatenate([top[:, :2], *rims])
    inner = _hexagonal(shape.base_radius, spacing)
    inner = inner[cKDTree(fixed).query(inner)[0] > 0.7 * spacing]
    inner = inner[np.linalg.norm(inner, axis=1) < shape.base_radius - 0.5 * spacing]
    points = np.concatenate([fixed, inner])
    faces = Delaunay(points).simplices
    _keep_rims(faces, [len(top), len(rims[0]), len(rims[1])])
    middle = points[faces].mean(axis=1)
    region = np.zeros(len(faces), np.uint8)
    for label, centre, axes in ((1, mitral, shape.mitral_semi_axes), (2, aortic, circle)):
        region[np.linalg.norm((middle - centre) / np.asarray(axes), axis=1) < 1] = label
    return points[len(top) :], faces, region


def _keep_rims(faces: np.ndarray, counts: list[int]) -> None:
    """Raise unless the closed rims numbered one after the other all are edges of the triangulation."""
    edges = {tuple(sorted(edge)) for edge in faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist()}
    start = 0
    for count in counts:
        for k in range(count):
            if tuple(sorted((start + k, start + (k + 1) % count))) not in edges:
                raise SurfaceError("ventricle: the spacing is too coarse to keep the rims of the orifices; refine it")
        start += count


def _hexagonal(radius: float, spacing: float) -> np.ndarray:
    """A triangular lattice over the disc's square, `(n, 2)`."""
    rows = np.arange(-np.ceil(radius / (spacing * 0.866)), np.ceil(radius / (spacing * 0.866)) + 1)
    columns = np.arange(-np.ceil(radius / spacing) - 1, np.ceil(radius / spacing) + 2)
    x, y = np.meshgrid(columns, rows)
    return np.stack([((x + 0.5 * (y % 2)) * spacing).ravel(), (y * spacing * np.sqrt(0.75)).ravel()], axis=1)


def _outward(vertices: np.ndarray, faces: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Faces of a convex surface turned so that they look away from a point inside."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = ((corner[:, 0] - inside) * normal).sum(axis=1) < 0
    return np.where(inward[:, None], faces[:, ::-1], faces)
