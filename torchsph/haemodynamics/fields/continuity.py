"""A velocity field brought to conserve mass between moving walls by the smallest change.

Blood is incompressible and cannot leave through the wall, so that through every cross-section passes what the walls
beyond it displace: for every smooth phi

    integral over the blood of u . grad phi dV = integral over its boundary of phi u . n dA,

with u . n that of the wall where there is wall. A field that was measured, smoothed or fetched from particles breaks
that at its largest scales, where no divergence of neighbouring nodes shows it: it passes too little. Of all changes
that mend it for every phi of a spline space, the smallest in the sum of squares over the blood is the gradient of a
spline psi (Chorin & Marsden 1993, sec. 1.3, in its weak form), one sparse system that serves all fields of a frame.

How blood passes an open orifice is left to the field: psi is 0 there, which is the condition of the smallest change,
and two orifices share what the walls displace as they need the least for it.

The blood's volume is counted by points that lie nearer to the wall than nodes do: cells that the wall cuts are divided,
and a part whose own node is beyond the wall belongs to the nearest one in the mask.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

import geometry
from regularize import Knots

__all__ = ["MassBalance"]

Array = NDArray[np.float64]

KNOTS = 4.0
"""Knot distance in grid spacings: the divergence of smaller scales is for differences of nodes to mend."""

MOST_CELLS = 2000
"""Cells of the spline that the blood may hold; a larger grid has wider knots."""

PARTS = 2
"""Into so many along each axis a cell is divided that the wall may cut."""

_NEAR = 1.8  # spacings from a node to the wall within which its cell may be cut
_FAR = 2.0  # spacings from the nearest node beyond which a part of a cell belongs to none
_HELD = 1e4  # how strongly psi is held at 0 on an orifice: times its own slope over a spacing
_RIDGE = 1e-8  # of the largest diagonal: splines that next to no blood touches, and the constant


class _Parts(NamedTuple):
    """Parts of the blood: their centres (n, D), m, the number of their node among the mask's (n,), volumes (n,)."""

    points: Array
    owner: NDArray[np.int64]
    volume: Array


class MassBalance:
    """The balance of mass in one frame, for any number of velocities.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`.
        wall: points of the wall at that time, orifices included (`geometry.WallSampler.at`).
        open_regions: labels of the orifices that let blood through at that time.

    Raises:
        ValueError: the mask has no node.
    """

    def __init__(
        self, grid: geometry.Grid, mask: ArrayLike, wall: geometry.WallPoints, open_regions: Collection[int] = ()
    ) -> None:
        self.grid, inside = grid, np.asarray(mask, bool)
        self.nodes = np.flatnonzero(inside)
        if not len(self.nodes):
            raise ValueError("MassBalance: the mask has no node, so that there is no blood")
        passing = np.isin(wall.region, list(open_regions))
        parts = _parts(grid, inside, wall)
        volume: Array = np.bincount(parts.owner, weights=parts.volume, minlength=len(self.nodes)).astype(np.float64)
        step = max(KNOTS * min(grid.spacing), (float(volume.sum()) / MOST_CELLS) ** (1 / grid.dimension))
        self._assemble(parts, volume, wall, passing, step)

    def nearest(self, velocity: ArrayLike, *, at_rest: bool = False) -> Array:
        """The fields `(*batch, D, *shape)`, m/s, nearest to `velocity` like it that conserve mass.

        Args:
            velocity: m/s; what lies outside the mask stays as it is.
            at_rest: the walls are: for differences of fields that both conserve mass.
        """
        array = np.asarray(velocity, np.float64)
        out = array.reshape(-1, self.grid.dimension, self.grid.size).copy()
        values = out[..., self.nodes]
        swept = 0.0 if at_rest else self._swept[:, None]
        lacking = swept - sum(slope.T @ values[:, axis].T for axis, slope in enumerate(self._slopes))
        psi = self._factor.solve(np.ascontiguousarray(lacking))
        for axis, slope in enumerate(self._slopes):
            out[:, axis, self.nodes] += (slope @ psi).T / self._volume
        return out.reshape(array.shape)

    def _assemble(
        self, parts: _Parts, volume: Array, wall: geometry.WallPoints, passing: NDArray[np.bool_], step: float
    ) -> None:
        dimension, spacing = self.grid.dimension, min(self.grid.spacing)
        corners = np.concatenate([parts.points, wall.points])
        knots = Knots.covering(corners.min(0), corners.max(0), (step,) * dimension, degree=2)
        everywhere = [_rows(knots, parts.points, axis) for axis in range(dimension)]
        used = np.flatnonzero(sum(abs(rows).sum(0) for rows in everywhere) > 0)
        gather = csr_array((parts.volume, (parts.owner, np.arange(len(parts.owner)))), (len(volume), len(parts.owner)))
        # (nodes, splines): the integral of a spline's slope over the blood that belongs to a node
        self._slopes = [csr_array(gather @ rows[:, used]) for rows in everywhere]
        self._volume = volume
        on_wall = _rows(knots, wall.points)[:, used]
        flux = wall.areas * (wall.normals * wall.velocities).sum(1) * ~passing
        if not passing.any():  # walls of a closed cavity whose volume changes are wrong alike everywhere
            flux = flux - wall.areas * (flux.sum() / wall.areas.sum())
        self._swept = on_wall.T @ flux
        matrix = sum(slope.T @ diags_array(1 / volume) @ slope for slope in self._slopes)
        matrix = matrix + on_wall.T @ diags_array(_HELD / spacing * wall.areas * passing) @ on_wall
        ridge = _RIDGE * float(matrix.diagonal().max())
        self._factor = splu(csc_array(matrix + diags_array(np.full(len(used), ridge))))


def _parts(grid: geometry.Grid, mask: NDArray[np.bool_], wall: geometry.WallPoints) -> _Parts:
    """The blood in parts: whole cells inside, divided ones along the wall, each with its node; none without one."""
    nodes, inside = grid.nodes().double().numpy(), mask.reshape(-1)
    spacing, tree = np.asarray(grid.spacing), cKDTree(wall.points)
    near = tree.query(nodes, distance_upper_bound=_NEAR * spacing.max())[0] < np.inf
    chosen = np.flatnonzero(inside)
    number = np.full(len(nodes), -1)
    number[chosen] = np.arange(len(chosen))
    offset = ((np.arange(PARTS) + 0.5) / PARTS - 0.5)[:, None] * spacing
    grids = np.meshgrid(*offset.T, indexing="ij")
    moves = np.stack([one.reshape(-1) for one in grids], axis=1)
    points = (nodes[near][:, None] + moves).reshape(-1, grid.dimension)
    closest = tree.query(points)[1]
    within = ((points - wall.points[closest]) * wall.normals[closest]).sum(1) < 0
    points, owner = points[within], number[np.repeat(np.flatnonzero(near), len(moves))[within]]
    lost = owner < 0
    if lost.any():
        distance, found = cKDTree(nodes[chosen]).query(points[lost])
        owner[lost] = np.where(distance <= _FAR * spacing.max(), found, -1)
    points, owner = points[owner >= 0], owner[owner >= 0]
    whole = np.flatnonzero(inside & ~near)
    # a node of the mask that owns no part of the blood (the wall has passed it) counts as one part at its own place
    bare = np.setdiff1d(number[inside & near], owner)
    small = grid.cell_volume / len(moves)
    return _Parts(
        np.concatenate([nodes[whole], points, nodes[chosen[bare]]]),
        np.concatenate([number[whole], owner, bare]),
        np.concatenate([np.full(len(whole), grid.cell_volume), np.full(len(points) + len(bare), small)]),
    )


def _rows(knots: Knots, points: Array, slope_along: int | None = None) -> csr_array:
    """(points, splines): values of the splines at points, or their slopes along an axis."""
    cell, local = knots.locate(torch.from_numpy(np.ascontiguousarray(points)))
    orders = [int(axis == slope_along) for axis in range(knots.axes)]
    values, columns = knots.stencil(local, orders).numpy(), knots.local_nodes(cell).numpy()
    start = np.arange(len(points) + 1) * knots.local_size
    return csr_array((values.reshape(-1), columns.reshape(-1), start), shape=(len(points), knots.nodes))
