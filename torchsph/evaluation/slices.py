"""A plane cut through a recording: the picture that shows the jet, the vortex and the outflow at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

import geometry

from .boundary_flow import sample_inside

__all__ = ["Cut", "Plane", "body_points", "cut", "valve_plane"]


@dataclass(frozen=True)
class Plane:
    """Points `origin + s * across + t * along` (m), with s and t in `extent` = (s0, s1, t0, t1)."""

    origin: np.ndarray  # (D,)
    across: np.ndarray  # (D,) unit vector
    along: np.ndarray  # (D,) unit vector
    extent: tuple[float, float, float, float]


@dataclass(frozen=True)
class Cut:
    """One frame in a plane: in-plane velocity and speed at the pixels, not a number outside the blood."""

    across: np.ndarray  # (ns,) m
    along: np.ndarray  # (nt,) m
    velocity: np.ndarray  # (2, nt, ns) m/s, components across and along
    speed: np.ndarray  # (nt, ns) m/s, of the whole vector
    outline: np.ndarray  # (m, 2, 2) m, segments of the wall


def valve_plane(recording: geometry.Recording) -> Plane:
    """The plane through the centres of the first two orifices and the long axis.

    With fewer than two orifices the principal axes of the surface serve; a plane recording is its own plane.
    """
    points = body_points(recording)
    if recording.dimension == 2:
        origin, across, along = np.zeros(2), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    else:
        origin, across, along = _long_axis_plane(recording, points)
    s, t = (points - origin) @ across, (points - origin) @ along
    margin = 0.02 * max(np.ptp(s), np.ptp(t))
    return Plane(origin, across, along, (s.min() - margin, s.max() + margin, t.min() - margin, t.max() + margin))


def body_points(recording: geometry.Recording) -> np.ndarray:
    """Points (n, D), m, of the wall at all frames; without a wall the nodes that are ever in the mask."""
    if recording.wall is not None:
        return recording.wall.vertices.reshape(-1, recording.dimension)
    return recording.grid.nodes().numpy()[np.asarray(recording.mask, bool).any(axis=0).reshape(-1)]


def _long_axis_plane(recording: geometry.Recording, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    centres = []
    if recording.wall is not None:
        surface = recording.wall.at(0)
        labels = np.unique(surface.region[surface.region > 0])[:2]
        centres = [surface.centroids[surface.part(label)].mean(0) for label in labels]
    body = points.mean(0)
    principal = np.linalg.svd(points[:: max(1, len(points) // 5000)] - body, full_matrices=False)[2]
    across, upward = principal[1], principal[0]
    if centres:
        upward = np.mean(centres, axis=0) - body  # towards the base, which is drawn on top
    if len(centres) == 2:
        across = centres[1] - centres[0]
    across = across / np.linalg.norm(across)
    upward = upward - (upward @ across) * across
    if np.linalg.norm(upward) < 1e-9:
        upward = principal[0] - (principal[0] @ across) * across
    # Off the mesh's own symmetry plane by a hair: a plane through vertices cuts triangles in degenerate ways.
    origin = (np.mean(centres, axis=0) if centres else body) + 1e-7 * np.cross(across, upward)
    return origin, across, upward / np.linalg.norm(upward)


def cut(recording: geometry.Recording, velocity: np.ndarray, frame: int, plane: Plane, pixel: float) -> Cut:
    """`velocity` (D, *shape), m/s, of one frame on pixels of size `pixel` (m) inside the walls."""
    s0, s1, t0, t1 = plane.extent
    s, t = np.arange(s0, s1 + pixel, pixel), np.arange(t0, t1 + pixel, pixel)
    points = plane.origin + s[None, :, None] * plane.across + t[:, None, None] * plane.along
    outline = _outline(recording, frame, plane)
    flat = points.reshape(-1, points.shape[-1])
    sampled, covered = sample_inside(recording.grid, velocity, recording.mask[frame], flat)
    inside = covered
    if recording.wall is not None:
        inside = covered & _enclosed(np.stack(np.meshgrid(s, t), -1).reshape(-1, 2), outline)
    sampled = np.where(inside[:, None], sampled, np.nan).reshape(len(t), len(s), -1)
    in_plane = np.stack([sampled @ plane.across, sampled @ plane.along])
    return Cut(s, t, in_plane, np.linalg.norm(sampled, axis=-1), outline)


def _outline(recording: geometry.Recording, frame: int, plane: Plane) -> np.ndarray:
    if recording.wall is None:
        return np.zeros((0, 2, 2))
    surface = recording.wall.at(frame)
    if recording.dimension == 2:
        segments = surface.vertices[surface.faces]
    else:
        normal = np.cross(plane.across, plane.along)
        segments = trimesh.intersections.mesh_plane(surface.trimesh(), normal, plane.origin)
    relative = np.asarray(segments).reshape(-1, 2, len(plane.origin)) - plane.origin
    return np.stack([relative @ plane.across, relative @ plane.along], axis=-1)


def _enclosed(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Even-odd rule: points (n, 2) whose ray crosses the segments (m, 2, 2) an odd number of times."""
    odd = np.zeros(len(points), bool)
    x, y = points[:, 0], points[:, 1]
    for (x0, y0), (x1, y1) in segments:
        if y0 == y1:
            continue
        straddles = (y0 > y) != (y1 > y)
        odd ^= straddles & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return odd
