"""The closest wall point of every node of a grid: distance and velocity, by compiled code or by scipy's k-d tree."""

from __future__ import annotations

import ctypes

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from geometry import Grid, Surface
from geometry.surfaces.closest import SurfaceIndex
from torchsph.native.library import LibraryMissing, library
from torchsph.native.structures import ClosestArguments


def closest_on_grid(grid: Grid, solid: Surface, values: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closest point of a surface to every node of a grid.

    Exact (for the faces as they are) where the distance is below ``limit`` (n,), m; farther away the closest point of
    a node that is, so that the distance is a bound from above. A node spacing has to be the same along all axes.

    Measured on one core, 263,424 nodes: 6,394 faces 0.10 s compiled and 0.57 s by the k-d tree, 160,636 faces 0.7 and
    1.4 s.

    Args:
        grid: n nodes.
        solid: the surface, m.
        values: (nv, D), of its vertices.
        limit: (n,), m, distance below which the answer has to be exact.

    Returns:
        Distance (n,), m, and ``values`` at the closest point (n, D).
    """
    try:
        handle = library().handle
    except LibraryMissing:
        return closest_by_tree(grid, solid, values, limit)
    return _compiled(handle, grid, solid, values, limit)


def _compiled(
    handle: ctypes.CDLL, grid: Grid, solid: Surface, values: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    dimension = grid.dimension
    if max(grid.size, len(solid.faces)) > np.iinfo(np.int32).max:
        raise ValueError(f"a wall table of {grid.size} nodes is more than an int32 can number; use a larger spacing")
    if limit.shape != (grid.size,) or values.shape != solid.vertices.shape:
        raise ValueError(
            f"limits {limit.shape} and values {values.shape} are not those of {grid.size} nodes and the wall"
        )
    distance, carried = np.empty(grid.size), np.zeros((grid.size, dimension))
    arrays: dict[str, np.ndarray] = {
        "vertices": np.ascontiguousarray(solid.vertices, np.float64),
        "values": np.ascontiguousarray(values, np.float64),
        "corners": np.ascontiguousarray(solid.faces, np.int32),
        "limit": np.ascontiguousarray(limit, np.float64),
        "distance": distance,
        "carried": carried,
    }
    handle.sph_grid_closest(
        ctypes.byref(
            ClosestArguments(
                dimension=dimension,
                threads=torch.get_num_threads(),
                faces=len(solid.faces),
                step=grid.spacing[0],
                origin=(ctypes.c_double * 3)(*grid.origin),
                counts=(ctypes.c_int64 * 3)(*grid.shape[::-1]),
                **{name: array.ctypes.data for name, array in arrays.items()},
            )
        )
    )
    return distance, carried


def closest_by_tree(grid: Grid, solid: Surface, values: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As ``closest_on_grid``, without compiled code; every node farther away than its limit takes the nearest one."""
    nodes = grid.nodes().numpy()
    index = SurfaceIndex(solid, grid.spacing[0])
    # the nodes of faces' corners stand for the surface: no point of it is farther from them than this
    place = (index.points - np.asarray(grid.origin)) / grid.spacing[0]
    marks = tuple(np.clip(np.rint(place), 0, np.array(grid.shape[::-1]) - 1).astype(np.int64).T[::-1])
    empty = np.ones(grid.shape, bool)
    empty[marks] = False
    slack = index.cover_radius + grid.spacing[0]
    near = distance_transform_edt(empty, sampling=grid.spacing[::-1]).reshape(-1) <= limit + slack
    rows = np.flatnonzero(near)
    found = index.query(nodes[rows])
    number = np.cumsum(near) - 1
    donor = distance_transform_edt(~near.reshape(grid.shape), return_distances=False, return_indices=True)
    donor = number[np.ravel_multi_index(tuple(donor), grid.shape).reshape(-1)]
    distance = np.linalg.norm(nodes - found.point(solid)[donor], axis=1)
    distance[rows] = found.distance
    return distance, found.interpolate(solid, values)[donor]
