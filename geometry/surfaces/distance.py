"""Signed distance of a closed surface on a grid: positive inside, exact in a band around the surface.

Sources: closest points by `closest`, the sign by the winding number of grid lines (`winding`), which also
holds where a surface touches itself; angle-weighted pseudo-normals (Baerentzen and Aanaes 2005) would not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from geometry.arguments import ENDLESS, checked
from geometry.grids.grid import Grid

from .closest import Closest, SurfaceIndex
from .surface import Surface
from .winding import grid_winding


class GridDistance(NamedTuple):
    """Signed distance (m) `shape`, and the closest surface point of every node in flattened order."""

    distance: np.ndarray
    closest: Closest


@checked(band=ENDLESS)
def signed_distance(grid: Grid, surface: Surface, *, band: float | None = None) -> np.ndarray:
    """Distance to the surface at every node, m, float64 `shape`: positive inside the fluid, negative outside.

    Exact to round-off for the given faces, with a `band` (m) only within it. Beyond the band a node takes the
    closest face of the nearest node in the band, so that its distance is too large by up to most of a
    spacing.

    Measured on one core, processor time, against libraries on the same 143,775 nodes and 5,112 faces: this
    function 0.7 s everywhere and 0.4 s with a band of 3 spacings; libigl 2.6.3 (`signed_distance`, C++) 0.35
    s everywhere, equal to 7e-18 m; trimesh 5.2 with rtree (`proximity.signed_distance`) 93 s. libigl would
    gain a factor of two for a compiled dependency, so that the k-d tree of SciPy stays. 132,650 faces and
    24,375 nodes: 0.8 s.

    Raises:
        SurfaceError: a surface that is open or inside out.
        ValueError: dimensions that differ, a band that is not positive.
    """
    return distance_and_closest(grid, surface, band=band).distance


@checked(band=ENDLESS)
def distance_and_closest(grid: Grid, surface: Surface, *, band: float | None = None) -> GridDistance:
    """`signed_distance` together with the closest surface points that it found."""
    if grid.dimension != surface.dimension:
        raise ValueError(f"signed_distance: a {surface.dimension}-D surface on a {grid.dimension}-D grid")
    if band is not None and not band > 0:
        raise ValueError(f"signed_distance: band must be positive (m) or None, not {band}")
    surface.check()
    nodes = grid.nodes().numpy()
    index = SurfaceIndex(surface, resolution=max(grid.spacing))
    near = _near_nodes(grid, index, band)
    closest = index.query(nodes) if near is None else _banded(grid, index, nodes, near)
    inside = grid_winding(grid, surface.vertices, surface.faces) > 0
    distance = closest.distance.reshape(grid.shape)
    return GridDistance(np.where(inside, distance, -distance), closest)


def _near_nodes(grid: Grid, index: SurfaceIndex, band: float | None) -> np.ndarray | None:
    """Nodes that may lie within the band, bool `shape`; None where that is not worth telling apart."""
    if band is None:
        return None
    place = (index.points - np.asarray(grid.origin)) / np.asarray(grid.spacing)
    limit = np.array(grid.shape[::-1]) - 1
    # A surface outside the box leaves its marks on the box's faces, where it is closest.
    marks = tuple(np.clip(np.rint(place), 0, limit).astype(np.int64).T[::-1])
    empty = np.ones(grid.shape, bool)
    empty[marks] = False
    reach = band + index.cover_radius + 0.5 * float(np.linalg.norm(grid.spacing))
    near = distance_transform_edt(empty, sampling=grid.spacing[::-1]) <= reach
    return None if near.all() else near


def _banded(grid: Grid, index: SurfaceIndex, nodes: np.ndarray, near: np.ndarray) -> Closest:
    rows = np.flatnonzero(near)
    exact = index.query(nodes[rows])
    number = np.zeros(grid.size, np.int64)
    number[rows] = np.arange(len(rows))
    # Every node measures its distance from the face of the nearest node in the band, there itself.
    options = {"sampling": grid.spacing[::-1], "return_distances": False, "return_indices": True}
    nearest = distance_transform_edt(~near, **options)
    source = number[np.ravel_multi_index(tuple(nearest), grid.shape).ravel()]
    return index.on_faces(nodes, exact.face[source])
