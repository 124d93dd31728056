"""Surfaces from point clouds, masks and velocity by Delaunay triangulation with an explicit concavity rule.

The thesis (section 3.4) sent the boundary points of a thresholded velocity to qhull and took the convex
result. Here the triangulation keeps the simplices whose circumscribed sphere is no larger than alpha
(Edelsbrunner and Muecke 1994, "Three-dimensional alpha shapes"), so that concavities wider than 2 alpha
appear; an infinite alpha is the convex hull.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from .grid import Grid
from .surface import Surface, SurfaceError

# qhull triangulates points on a common sphere, as on a grid, in pieces without volume; a shift of this part
# of the points' spacing, used for the choice of simplices only, makes the choice unique.
JOGGLE = 1e-4


def surface_from_points(points: np.ndarray, *, alpha: float) -> Surface:
    """The outer surface of a cloud of points `(n, D)`, m, concave down to `alpha` (m).

    The points must fill the body, not only its surface, unless alpha exceeds the body's radius. Of several
    separate bodies the largest is taken; cavities are filled. Raises SurfaceError for too few points, points
    in a plane, or an alpha below half the spacing of the points.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not np.isfinite(points).all():
        raise SurfaceError(f"surface_from_points: points must be finite (n, 2) or (n, 3), not {points.shape}")
    if not alpha > 0:
        raise SurfaceError(f"surface_from_points: alpha must be a positive length (m), not {alpha}")
    simplices, neighbours = _delaunay(points)
    keep = _circumradius(points[simplices]) <= alpha
    if not keep.any():
        raise SurfaceError(f"surface_from_points: no simplex is as small as alpha = {alpha:g} m; raise it")
    keep = _largest_body(points, simplices, neighbours, keep)
    faces = _boundary(points, simplices, neighbours, _without_cavities(neighbours, keep))
    used, place = np.unique(faces, return_inverse=True)
    return Surface(points[used], place.reshape(faces.shape))


def surface_from_mask(
    mask: np.ndarray, grid: Grid, *, alpha: float | None = None, smoothing: int = 0
) -> Surface:
    """The surface of a segmentation `mask` (*shape), True inside: of its largest connected part, filled.

    The surface runs midway between nodes inside and outside. `alpha` (m) as above; the default, 1.1 half
    diagonals of a cell, follows every concavity of the mask. `smoothing` passes of Taubin's filter (1995,
    which does not shrink) take the steps out of it. Raises SurfaceError for an empty mask.
    """
    mask = np.asarray(mask).astype(bool)
    if mask.shape != grid.shape:
        raise SurfaceError(
            f"surface_from_mask: the mask must have the grid's shape {grid.shape}, not {mask.shape}"
        )
    body = _filled(mask)
    inside = grid.nodes().numpy()[body.ravel()]
    points = np.concatenate([inside, _midway(body, grid)])
    size = 0.55 * float(np.linalg.norm(grid.spacing)) if alpha is None else alpha
    surface = surface_from_points(points, alpha=size)
    return taubin(surface, smoothing) if smoothing else surface


def surface_from_velocity(
    velocity: np.ndarray,
    grid: Grid,
    *,
    threshold: float = 0.0,
    alpha: float | None = None,
    smoothing: int = 0,
) -> Surface:
    """The surface around the nodes whose speed exceeds `threshold` (m/s), as in the thesis (section 4.1).

    `velocity` (D, *shape) or (T, D, *shape), m/s: with frames, a node counts that exceeds it in any of them.
    Only for fields that are zero outside the blood: the thesis notes that it does not work in vivo. Further
    as `surface_from_mask`.
    """
    velocity = np.asarray(velocity, np.float64)
    speed = np.sqrt((velocity**2).sum(axis=-1 - grid.dimension))
    if speed.shape[-grid.dimension :] != grid.shape or speed.ndim > grid.dimension + 1:
        raise SurfaceError(
            f"surface_from_velocity: the velocity {velocity.shape} does not fit the grid {grid.shape}"
        )
    moving = speed > threshold
    mask = moving.any(axis=0) if moving.ndim > grid.dimension else moving
    return surface_from_mask(mask, grid, alpha=alpha, smoothing=smoothing)


def taubin(surface: Surface, passes: int, *, shrink: float = 0.5, inflate: float = 0.53) -> Surface:
    """Taubin 1995, "A signal processing approach to fair surface design": smooth, then inflate, each pass."""
    count = len(surface.vertices)
    pairs = (
        surface.faces[:, [0, 1]]
        if surface.dimension == 2
        else surface.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    )
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    graph = ((graph + graph.T) > 0).astype(np.float64)
    degree = np.maximum(graph.sum(axis=1), 1)[:, None]
    vertices = surface.vertices
    for _ in range(passes):
        for factor in (shrink, -inflate):
            vertices = vertices + factor * (graph @ vertices / degree - vertices)
    return surface.moved(vertices)


def _delaunay(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    spread = (points.max(axis=0) - points.min(axis=0)).max() / max(len(points), 1) ** (1 / points.shape[1])
    # A fixed sequence: the same points give the same surface.
    shift = np.random.default_rng(0).uniform(-JOGGLE, JOGGLE, points.shape) * spread
    try:
        result = Delaunay(points + shift)
    except (QhullError, ValueError) as fault:
        reason = str(fault).strip().splitlines()[0]
        raise SurfaceError(
            f"surface_from_points: {len(points)} points cannot be triangulated ({reason})"
        ) from fault
    return result.simplices, result.neighbors


def _circumradius(corner: np.ndarray) -> np.ndarray:
    """Radius of the sphere through the corners `(n, D + 1, D)`; infinite for simplices without volume."""
    along = corner[:, 1:] - corner[:, :1]
    square = (along**2).sum(axis=2)
    scale = np.sqrt(square.max(axis=1))
    flat = np.abs(np.linalg.det(along)) <= 1e-12 * scale ** corner.shape[2]
    along[flat] = np.eye(corner.shape[2])
    centre = np.linalg.solve(2 * along, square[..., None])[..., 0]
    return np.where(flat, np.inf, np.sqrt((centre**2).sum(axis=1)))


def _largest_body(points, simplices, neighbours, keep) -> np.ndarray:
    row, side = np.nonzero((neighbours >= 0) & keep[:, None])
    other = neighbours[row, side]
    linked = keep[other]
    graph = coo_array(
        (np.ones(linked.sum(), np.int8), (row[linked], other[linked])), shape=(len(simplices),) * 2
    )
    label = connected_components(graph, directed=False)[1]
    corner = points[simplices]
    volume = np.abs(np.linalg.det(corner[:, 1:] - corner[:, :1])) * keep
    return keep & (label == np.bincount(label, weights=volume).argmax())


def _without_cavities(neighbours: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Kept simplices and all others that are not connected to the outside of the hull."""
    row, side = np.nonzero((neighbours >= 0) & ~keep[:, None])
    other = neighbours[row, side]
    linked = ~keep[other]
    outside = len(keep)
    open_to = np.flatnonzero((neighbours < 0).any(axis=1) & ~keep)
    rows = np.concatenate([row[linked], open_to])
    columns = np.concatenate([other[linked], np.full(len(open_to), outside)])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(outside + 1,) * 2)
    label = connected_components(graph, directed=False)[1]
    return keep | (label[:-1] != label[outside])


def _boundary(points, simplices, neighbours, keep) -> np.ndarray:
    """Faces between kept simplices and the rest, numbered outwards."""
    beyond = np.where(neighbours >= 0, ~keep[neighbours], True)
    row, corner = np.nonzero(keep[:, None] & beyond)
    dimension = points.shape[1]
    others = np.array([[k for k in range(dimension + 1) if k != c] for c in range(dimension + 1)])
    faces = np.take_along_axis(simplices[row], others[corner], axis=1)
    apex = points[simplices[row, corner]]
    first = points[faces[:, 0]]
    along = points[faces[:, 1:]] - first[:, None]
    # In a plane, an edge followed counter-clockwise has the body on its left; in space, the normal points
    # away from it.
    matrix = np.concatenate([along, (apex - first)[:, None]], axis=1)
    inward = np.linalg.det(matrix) > 0
    turn = ~inward if dimension == 2 else inward
    faces[turn] = faces[turn][:, ::-1]
    return faces


def _filled(mask: np.ndarray) -> np.ndarray:
    label, count = ndimage.label(mask)
    if count == 0:
        raise SurfaceError("surface_from_mask: no node is inside the mask")
    largest = np.bincount(label.ravel())[1:].argmax() + 1
    return ndimage.binary_fill_holes(label == largest)


def _midway(body: np.ndarray, grid: Grid) -> np.ndarray:
    """Points halfway between nodes inside and neighbours outside, also off the grid's box: `(n, D)`, m."""
    padded = np.pad(body, 1)
    found = []
    for axis in range(body.ndim):
        low = np.moveaxis(padded, axis, 0)
        index = np.argwhere(low[1:] != low[:-1]).astype(np.float64)
        index[:, 0] += 0.5
        index = np.insert(index[:, 1:], axis, index[:, 0], axis=1) - 1.0
        found.append(np.asarray(grid.origin) + index[:, ::-1] * np.asarray(grid.spacing))
    return np.concatenate(found)
