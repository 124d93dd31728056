"""Closed surfaces of simple bodies at a chosen spacing: bodies of revolution, boxes, plane outlines.

The vertices lie on the body, so that the volume of the mesh converges to the body's with the square of the
spacing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.arguments import ENDLESS, checked
from geometry.grids.given import numbers

from .surface import Surface, SurfaceError

# pieces that a side is cut into at most: more than any computer meshes
_MOST = 20_000


@checked
def ellipsoid(semi_axes: Sequence[float], spacing: float, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> Surface:
    """An ellipsoid, semi-axes (m) along x, y, z, around `centre`; `spacing` (m) between its vertices."""
    axes = _positive("ellipsoid: semi_axes", semi_axes, 3)
    _positive("ellipsoid: spacing", [spacing], 1)
    steps = _count(np.pi * float(axes.max()), spacing, 3)
    angle = np.linspace(0, np.pi, steps + 1)
    unit = revolved(np.stack([np.sin(angle), np.cos(angle)], axis=1), spacing / float(axes.max()))
    return unit.moved(unit.vertices * axes + _numbers("ellipsoid: centre", centre, 3))


@checked
def tube(radius: float, length: float, spacing: float) -> Surface:
    """A pipe along z from 0 to `length` (m): wall (region 0), inlet at z = 0 (1), outlet at the end (2)."""
    _positive("tube: radius, length, spacing", [radius, length, spacing], 3)
    across, along = _count(radius, spacing, 1), _count(length, spacing, 1)
    r = np.concatenate(
        [np.linspace(0, radius, across + 1), np.full(along - 1, radius), np.linspace(radius, 0, across + 1)]
    )
    z = np.concatenate([np.zeros(across), np.linspace(0, length, along + 1), np.full(across, length)])
    region = np.repeat([1, 0, 2], [across, along, across])
    return revolved(np.stack([r, z], axis=1), spacing, region)


@checked
def box(lower: Sequence[float], upper: Sequence[float], spacing: float) -> Surface:
    """A box between two corners (m), its sides cut at about `spacing`; one region, the wall."""
    first = _numbers("box: lower", lower, 3)
    size = _positive("box: upper - lower", _numbers("box: upper", upper, 3) - first, 3)
    _positive("box: spacing", [spacing], 1)
    count = np.array([_count(side, spacing, 1) for side in size])
    points: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        i, j = (a.ravel() for a in np.meshgrid(np.arange(count[u]), np.arange(count[v]), indexing="ij"))
        for side in (0, 1):
            start = sum(len(part) for part in points)
            lattice = np.zeros(((count[u] + 1) * (count[v] + 1), 3), np.int64)
            lattice[:, axis] = side * count[axis]
            lattice[:, u], lattice[:, v] = np.divmod(np.arange(len(lattice)), count[v] + 1)
            a = start + i * (count[v] + 1) + j
            quads = np.stack([a, a + count[v] + 1, a + count[v] + 2, a + 1], axis=1)
            quads = quads if side else quads[:, ::-1]
            points.append(lattice)
            faces.append(quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
    # The sides were made one by one; lattice coordinates tell exactly which of their vertices coincide.
    lattice, place = np.unique(np.concatenate(points), axis=0, return_inverse=True)
    return Surface(first + lattice / count * size, place.reshape(-1)[np.concatenate(faces)])


@checked
def ellipse(semi_axes: Sequence[float], spacing: float, centre: Sequence[float] = (0.0, 0.0)) -> Surface:
    """An ellipse in the plane, semi-axes (m) along x and y, as a closed polyline."""
    axes = _positive("ellipse: semi_axes", semi_axes, 2)
    _positive("ellipse: spacing", [spacing], 1)
    return polygon(ellipse_rim(axes, spacing) + _numbers("ellipse: centre", centre, 2), np.inf)


@checked(spacing=ENDLESS)
def polygon(corners: np.ndarray, spacing: float) -> Surface:
    """A closed polyline through `corners (n, 2)`, m, counter-clockwise, cut at about `spacing`."""
    corners = np.asarray(corners, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise SurfaceError(f"polygon: corners must be (n, 2) with n >= 3, not {corners.shape}")
    if not np.isfinite(corners).all() or not spacing > 0:
        raise SurfaceError(f"polygon: corners must be finite and spacing positive (m), got a spacing of {spacing}")
    sides = np.roll(corners, -1, axis=0) - corners
    count = [_count(side, spacing, 1) for side in np.linalg.norm(sides, axis=1)]
    pieces = [c + np.arange(n)[:, None] / n * s for c, s, n in zip(corners, sides, count, strict=True)]
    points = np.concatenate(pieces)
    number = np.arange(len(points))
    surface = Surface(points, np.stack([number, np.roll(number, -1)], axis=1))
    surface.check()
    return surface


def ellipse_rim(semi_axes: Sequence[float] | np.ndarray, spacing: float) -> np.ndarray:
    """Points evenly along an ellipse, about `spacing` apart, counter-clockwise: `(n, 2)`, m."""
    fine = np.linspace(0, 2 * np.pi, 2001)
    points = np.stack([semi_axes[0] * np.cos(fine), semi_axes[1] * np.sin(fine)], axis=1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    count = _count(length[-1], spacing, 8)
    angle = np.interp(np.arange(count) / count * length[-1], length, fine)
    return np.stack([semi_axes[0] * np.cos(angle), semi_axes[1] * np.sin(angle)], axis=1)


@checked
def revolved(profile: np.ndarray, spacing: float, region: np.ndarray | int = 0) -> Surface:
    """The body whose outline `profile (n, 2)` of (radius, z), m, starts and ends on the axis z.

    Every profile point becomes a ring of vertices about `spacing` apart; `region` labels the n - 1 bands
    between them.
    """
    profile = np.asarray(profile, np.float64)
    if profile.ndim != 2 or profile.shape[1] != 2 or len(profile) < 3:
        raise SurfaceError(f"revolved: profile must be (n, 2) with n >= 3, not {profile.shape}")
    if not np.isfinite(profile).all():
        raise SurfaceError("revolved: the profile must be finite (m)")
    _positive("revolved: spacing", [spacing], 1)
    if np.abs(profile[[0, -1], 0]).max() > 1e-9 * profile[:, 0].max() or (profile[1:-1, 0] <= 0).any():
        raise SurfaceError("revolved: the profile must start and end on the axis and stay off it between")
    rings = [ring_of(radius, z, spacing) for radius, z in profile[1:-1]]
    rings = [np.array([[0, 0, profile[0, 1]]]), *rings, np.array([[0, 0, profile[-1, 1]]])]
    first = np.concatenate([[0], np.cumsum([len(ring) for ring in rings])])
    bands = [stitched(first[k], len(rings[k]), first[k + 1], len(rings[k + 1])) for k in range(len(rings) - 1)]
    labels = np.repeat(np.broadcast_to(region, len(bands)), [len(band) for band in bands])
    surface = Surface(np.concatenate(rings), np.concatenate(bands), labels)
    return surface if surface.volume > 0 else Surface(surface.vertices, surface.faces[:, ::-1], labels)


def ring_of(radius: float, z: float, spacing: float) -> np.ndarray:
    """Vertices evenly on a circle around z, at least six: `(n, 3)`, m."""
    count = _count(2 * np.pi * radius, spacing, 6)
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1)


def stitched(first: int, count: int, second: int, other: int) -> np.ndarray:
    """Triangles between rings of `count` and `other` vertices numbered from `first`, `second`; 1: a pole."""
    faces, i, j = [], 0, 0
    ends = (count if count > 1 else 0, other if other > 1 else 0)
    while i < ends[0] or j < ends[1]:
        a, b = first + i % count, second + j % other
        # Step on the ring that lags behind in angle, seen from the middle of its next edge.
        if j >= ends[1] or (i < ends[0] and (i + 0.5) * other <= (j + 0.5) * count):
            faces.append((a, first + (i + 1) % count, b))
            i += 1
        else:
            faces.append((a, second + (j + 1) % other, b))
            j += 1
    return np.array(faces)


def _positive(name: str, values: Sequence[float] | np.ndarray, count: int) -> np.ndarray:
    array = _numbers(name, values, count)
    if not (array > 0).all():
        raise SurfaceError(f"{name} must be {count} positive lengths (m), not {values}")
    return array


def _numbers(name: str, values: Sequence[float] | np.ndarray, count: int) -> np.ndarray:
    """So many finite numbers (m)."""
    try:
        found = np.array(numbers(name, values))
    except ValueError as fault:
        raise SurfaceError(str(fault)) from None
    if len(found) != count:
        raise SurfaceError(f"{name} must be {count} numbers (m), not {values}")
    return found


def _count(length: float, spacing: float, least: int) -> int:
    """Pieces of about a spacing (m) that a length (m) is cut into."""
    pieces = length / spacing if np.isfinite(spacing) else 0.0
    if not pieces <= _MOST:
        raise SurfaceError(f"{length:g} m cut at {spacing:g} m gives {pieces:.3g} pieces, more than {_MOST}; both in m")
    return max(least, round(pieces))
