"""Surfaces from point clouds, masks and velocity by Delaunay triangulation with an explicit concavity rule.

Grønli 2017, sec. 3.4 sent the boundary points of a thresholded velocity to qhull, whose simplices together
fill the convex hull. Which of them are the body is decided here by a rule: for a cloud of points those whose
circumscribed sphere is no larger than alpha (Edelsbrunner and Muecke 1994, "Three-dimensional alpha shapes"),
so that concavities wider than 2 alpha appear and an infinite alpha is the convex hull; for a mask those whose
middle lies inside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from geometry.arguments import ANY, ENDLESS, NOT_NEGATIVE, between, checked, finite
from geometry.grids.grid import Grid

from .surface import Surface, SurfaceError

# qhull triangulates points on a common sphere, as on a grid, in pieces without volume. Moving the points by
# this part of their spacing, for the triangulation only, makes it unique and all its pieces regular.
JOGGLE = 1e-4
MOST_PASSES = 10_000  # of a filter; nothing of a surface is left long before


@checked(alpha=ANY)
def surface_from_points(points: np.ndarray, *, alpha: float) -> Surface:
    """The outer surface of a cloud of points `(n, D)`, m, concave down to `alpha` (m).

    The points must fill the body, not only its surface, unless alpha exceeds the body's radius. Of several
    separate bodies the largest is taken; cavities are filled.

    Raises:
        SurfaceError: too few points, points in a plane, or an alpha below half the spacing of the points.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not np.isfinite(points).all():
        raise SurfaceError(f"surface_from_points: points must be finite (n, 2) or (n, 3), not {points.shape}")
    if len(points) <= points.shape[1]:
        raise SurfaceError(f"surface_from_points: {len(points)} points cannot be triangulated: too few")
    if not alpha > 0:
        raise SurfaceError(f"surface_from_points: alpha must be a positive length (m), not {alpha}")
    mesh = _delaunay(points)
    keep = mesh.circumradius() <= alpha
    if not keep.any():
        raise SurfaceError(f"surface_from_points: no simplex is as small as alpha = {alpha:g} m; raise it")
    return mesh.surface(keep)


@checked(alpha=ENDLESS, smoothing=between(0, MOST_PASSES))
def surface_from_mask(mask: np.ndarray, grid: Grid, *, alpha: float = np.inf, smoothing: int = 0) -> Surface:
    """The surface of a segmentation `mask` (*shape), True inside: of its largest connected part, filled.

    It runs midway between nodes inside and outside and follows every concavity of the mask: a simplex belongs
    to the body where the mask, interpolated at its middle, is at least a half; `alpha` (m) may limit it
    further. `smoothing` passes of Taubin's filter take the steps out.

    Raises:
        SurfaceError: an empty mask.
    """
    mask = np.asarray(mask).astype(bool)
    if mask.shape != grid.shape:
        raise SurfaceError(f"surface_from_mask: the mask {mask.shape} does not fit the grid {grid.shape}")
    body, wide = np.pad(_filled(mask), 1), grid.padded(1)
    mesh = _delaunay(np.concatenate([wide.nodes().numpy()[body.ravel()], _midway(body, wide)]))
    level = wide.sample(torch.as_tensor(body, dtype=torch.float64), torch.as_tensor(mesh.middles()))
    surface = mesh.surface((level.numpy() >= 0.5) & (mesh.circumradius() <= alpha))
    return taubin(surface, smoothing) if smoothing else surface


@checked(velocity=finite(), threshold=NOT_NEGATIVE, alpha=ENDLESS, smoothing=between(0, MOST_PASSES))
def surface_from_velocity(
    velocity: np.ndarray,
    grid: Grid,
    *,
    threshold: float = 0.0,
    alpha: float = np.inf,
    smoothing: int = 0,
) -> Surface:
    """The surface around the nodes whose speed exceeds `threshold` (m/s), as in Grønli 2017, sec. 4.1.

    `velocity` (D, *shape) or (T, D, *shape), m/s: with frames, a node counts that exceeds it in any of them.
    Only for fields that are zero outside the blood: Grønli notes that it does not work in vivo. Further
    as `surface_from_mask`.
    """
    velocity = np.asarray(velocity, np.float64)
    if velocity.ndim <= grid.dimension:
        raise SurfaceError(f"surface_from_velocity: the velocity {velocity.shape} must have an axis of components")
    speed = np.sqrt((velocity**2).sum(axis=-1 - grid.dimension))
    if speed.shape[-grid.dimension :] != grid.shape or speed.ndim > grid.dimension + 1:
        raise SurfaceError(f"surface_from_velocity: the velocity {velocity.shape} does not fit the grid {grid.shape}")
    moving = speed > threshold
    mask = moving.any(axis=0) if moving.ndim > grid.dimension else moving
    return surface_from_mask(mask, grid, alpha=alpha, smoothing=smoothing)


@checked(passes=between(0, MOST_PASSES))
def taubin(surface: Surface, passes: int, *, shrink: float = 0.5, inflate: float = 0.53) -> Surface:
    """Taubin 1995, "A signal processing approach to fair surface design": smooth, then inflate, each pass."""
    count = len(surface.vertices)
    pairs = surface.faces[:, [0, 1]] if surface.dimension == 2 else surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    graph = ((graph + graph.T) > 0).astype(np.float64)
    degree = np.maximum(graph.sum(axis=1), 1)[:, None]
    vertices = surface.vertices
    for _ in range(passes):
        for factor in (shrink, -inflate):
            vertices = vertices + factor * (graph @ vertices / degree - vertices)
    return surface.moved(vertices)


@dataclass(frozen=True, eq=False)
class _Simplices:
    """A Delaunay triangulation: `points`, as `moved` for it, corners and neighbours of the simplices."""

    points: np.ndarray
    moved: np.ndarray
    corners: np.ndarray
    neighbours: np.ndarray

    def middles(self) -> np.ndarray:
        """Centroids of the simplices, `(n, D)`."""
        return self.moved[self.corners].mean(axis=1)

    def circumradius(self) -> np.ndarray:
        """Radius of the sphere through the corners of each simplex, `(n,)`."""
        corner = self.moved[self.corners]
        along = corner[:, 1:] - corner[:, :1]
        centre = np.linalg.solve(2 * along, (along**2).sum(axis=2)[..., None])[..., 0]
        return np.sqrt((centre**2).sum(axis=1))

    def surface(self, keep: np.ndarray) -> Surface:
        """The outer surface of the largest connected body among the kept simplices."""
        body = self._with_cavities(self._largest(keep))
        faces = self._boundary(body)
        used, place = np.unique(faces, return_inverse=True)
        return Surface(self.points[used], place.reshape(faces.shape))

    def _linked(self, chosen: np.ndarray, *more: np.ndarray) -> np.ndarray:
        """Labels of the pieces in which chosen simplices hang together by faces; `more` adds pairs."""
        row, side = np.nonzero((self.neighbours >= 0) & chosen[:, None])
        other = self.neighbours[row, side]
        pairs = np.stack([row, other])[:, chosen[other]]
        pairs = np.concatenate([pairs, *more], axis=1)
        size = len(self.corners) + 1
        graph = coo_array((np.ones(pairs.shape[1], np.int8), (pairs[0], pairs[1])), shape=(size, size))
        return connected_components(graph, directed=False)[1]

    def _largest(self, keep: np.ndarray) -> np.ndarray:
        label = self._linked(keep)[:-1]
        corner = self.moved[self.corners]
        volume = np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) * keep
        return keep & (label == np.bincount(label, weights=volume).argmax())

    def _with_cavities(self, keep: np.ndarray) -> np.ndarray:
        """Kept simplices and all others that are not connected to the outside, which is the last label."""
        rim = np.flatnonzero((self.neighbours < 0).any(axis=1) & ~keep)
        label = self._linked(~keep, np.stack([rim, np.full(len(rim), len(keep))]))
        return keep | (label[:-1] != label[-1])

    def _boundary(self, keep: np.ndarray) -> np.ndarray:
        """Faces between kept simplices and the rest, numbered outwards."""
        beyond = np.where(self.neighbours >= 0, ~keep[self.neighbours], True)
        row, corner = np.nonzero(keep[:, None] & beyond)
        count = self.corners.shape[1]
        others = np.array([[k for k in range(count) if k != c] for c in range(count)])
        faces = np.take_along_axis(self.corners[row], others[corner], axis=1)
        first = self.moved[faces[:, 0]]
        inner = self.moved[self.corners[row, corner]] - first
        along = self.moved[faces[:, 1:]] - first[:, None]
        volume = np.linalg.det(np.concatenate([along, inner[:, None]], axis=1))
        # In a plane the body lies to the left of an edge, in space behind a face seen counter-clockwise.
        turn = volume < 0 if count == 3 else volume > 0
        faces[turn] = faces[turn][:, ::-1]
        return faces


def _delaunay(points: np.ndarray) -> _Simplices:
    # Sorted, so that each point is moved alike in whatever order the points come.
    points = points[np.lexsort(points.T)]
    spread = (points.max(axis=0) - points.min(axis=0)).max() / len(points) ** (1 / points.shape[1])
    moved = points + np.random.default_rng(0).uniform(-JOGGLE, JOGGLE, points.shape) * spread
    try:
        result = Delaunay(moved)
    except (QhullError, ValueError) as fault:
        reason = str(fault).strip().splitlines()[0]
        text = f"surface_from_points: {len(points)} points cannot be triangulated ({reason})"
        raise SurfaceError(text) from fault
    return _Simplices(points, moved, result.simplices, result.neighbors)


def _filled(mask: np.ndarray) -> np.ndarray:
    label, count = ndimage.label(mask)
    if count == 0:
        raise SurfaceError("surface_from_mask: no node is inside the mask")
    largest = np.bincount(label.ravel())[1:].argmax() + 1
    return ndimage.binary_fill_holes(label == largest)


def _midway(body: np.ndarray, grid: Grid) -> np.ndarray:
    """Points halfway between nodes inside and neighbours outside, `(n, D)`, m."""
    found = []
    for axis in range(body.ndim):
        index = np.argwhere(np.diff(body, axis=axis)).astype(np.float64)
        index[:, axis] += 0.5
        found.append(np.asarray(grid.origin) + index[:, ::-1] * np.asarray(grid.spacing))
    return np.concatenate(found)
