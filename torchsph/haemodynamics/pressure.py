"""Relative pressure of a masked domain from its gradient: the pressure Poisson equation, solved as least squares.

Wanted is p whose differences along the edges between neighbouring nodes of the mask fit the gradient g best:

    minimise  sum over edges (i, j) of (h_x h_y h_z / h^2) (p_j - p_i - h (g_i + g_j) . e / 2)^2.

Its normal equations are the five-point (seven-point) Poisson equation lap p = div g with Neumann data n . grad p =
n . g at the border of the mask (Gresho & Sani 1987; Ebbers & Farnebaeck 2009 for flow data). The gradient is known from
momentum at every node, the last one before the wall included, so that the stairs of the mask bring no error: where g is
a gradient p is exact to second order, and where g has errors the part of them that is no gradient drops out.

A pressure is known up to a constant, for each part of the mask that hangs together: the mean of each is set to 0. The
`difference` between two places does not depend on that, within one part.

The members of a frame share its equations and are solved for side by side, by conjugate gradients: about 150 products
with a matrix of 7 entries a row, where a factor of it would take a hundred times as long.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

import geometry

__all__ = ["PressureSolver", "pressure_difference", "region_mean"]

Array = NDArray[np.float64]

TOLERANCE = 1e-12
"""Of the residual, relative: a few more steps than any measured gradient would need, and exact tests stay exact."""


class PressureSolver:
    """Pressure on the nodes of one mask.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`.
        tolerance: of the residual, relative.

    Raises:
        ValueError: the mask does not lie on the grid or has no node.
    """

    def __init__(self, grid: geometry.Grid, mask: ArrayLike, tolerance: float = TOLERANCE) -> None:
        self.grid, self.mask, self.tolerance = grid, np.asarray(mask, bool), tolerance
        if self.mask.shape != grid.shape:
            raise ValueError(f"PressureSolver: the mask must be {grid.shape} as the grid, not {self.mask.shape}")
        if not self.mask.any():
            raise ValueError("PressureSolver: the mask has no node, so that there is no pressure")
        self.nodes = np.flatnonzero(self.mask)
        number = np.full(grid.size, -1)
        number[self.nodes] = np.arange(len(self.nodes))
        self._edges = [self._edges_along(number.reshape(grid.shape), axis) for axis in range(grid.dimension)]
        self._differences = self._difference_matrix()
        links = abs(self._differences.T @ self._differences)
        self.parts: NDArray[np.int32] = connected_components(links, directed=False)[1]

    def solve(self, gradient: ArrayLike) -> Array:
        """Pressure `(*batch, *shape)`, Pa, of mean 0 over each part of the mask; 0 outside it.

        Args:
            gradient: `(*batch, D, *shape)`, Pa/m.

        Raises:
            ValueError: the gradient has another shape or is not finite in the mask.
        """
        array = np.asarray(gradient)
        expected = (self.grid.dimension, *self.grid.shape)
        if array.shape[-len(expected) :] != expected:
            raise ValueError(f"PressureSolver: the gradient must be (..., {expected}), not {array.shape}")
        lead = array.shape[: -len(expected)]
        values = array.reshape(-1, self.grid.dimension, self.grid.size)[..., self.nodes].astype(np.float64)
        if not np.isfinite(values).all():
            raise ValueError("PressureSolver: the gradient is not finite everywhere in the mask")
        wanted = [0.5 * (values[:, axis, low] + values[:, axis, high]) for axis, (low, high) in enumerate(self._edges)]
        right = self._differences.T @ (self.grid.cell_volume * np.concatenate(wanted, axis=1).T)
        pressure = self._without_means(self._conjugate_gradients(right))
        result = np.zeros((len(values), self.grid.size))
        result[:, self.nodes] = pressure.T
        return result.reshape(*lead, *self.grid.shape)

    def _edges_along(self, number: NDArray[np.int64], axis: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of the two nodes of every edge along x (0), y, z."""
        array_axis = number.ndim - 1 - axis
        size = number.shape[array_axis]
        low, high = (np.take(number, range(*ends), axis=array_axis).ravel() for ends in ((0, size - 1), (1, size)))
        both = (low >= 0) & (high >= 0)
        return low[both], high[both]

    def _difference_matrix(self) -> csr_array:
        """(p_j - p_i) / h of all edges, x first: `(edges, nodes)`."""
        rows, columns, values, start = [], [], [], 0
        for (low, high), step in zip(self._edges, self.grid.spacing, strict=True):
            edge = start + np.arange(len(low))
            rows += [edge, edge]
            columns += [low, high]
            values += [np.full(len(low), -1 / step), np.full(len(low), 1 / step)]
            start += len(low)
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return csr_array(entries, shape=(start, len(self.nodes)))

    def _without_means(self, values: Array) -> Array:
        """Values `(nodes, n)` less their mean over each part."""
        return values - (self._averages @ values)[self.parts]

    @cached_property
    def _averages(self) -> csr_array:
        share = 1 / np.bincount(self.parts)[self.parts]
        return csr_array((share, (self.parts, np.arange(len(self.nodes)))))

    def _conjugate_gradients(self, right: Array) -> Array:
        """Solve for all columns of `right` `(nodes, n)` side by side, Jacobi preconditioned.

        Raises:
            RuntimeError: the iteration does not converge (it always does for a finite right-hand side).
        """
        matrix = csr_array(self._differences.T @ self._differences) * self.grid.cell_volume
        diagonal = matrix.diagonal()
        inverse = np.where(diagonal > 0, 1 / np.where(diagonal > 0, diagonal, 1.0), 0.0)[:, None]
        solution, residual = np.zeros_like(right), self._without_means(right)
        goal = self.tolerance * np.linalg.norm(residual, axis=0)
        direction = conditioned = inverse * residual
        energy = (residual * conditioned).sum(0)
        for _ in range(10 * len(self.nodes) + 10):
            if (np.linalg.norm(residual, axis=0) <= goal).all():
                return solution
            image = matrix @ direction
            bend = (direction * image).sum(0)
            step = np.where(bend > 0, energy / np.where(bend > 0, bend, 1.0), 0.0)  # 0 for a column that is done
            solution, residual = solution + step * direction, residual - step * image
            conditioned = inverse * residual
            before, energy = energy, (residual * conditioned).sum(0)
            direction = conditioned + np.where(before > 0, energy / np.where(before > 0, before, 1.0), 0.0) * direction
        raise RuntimeError("PressureSolver: the conjugate gradients did not converge")


def region_mean(pressure: ArrayLike, mask: ArrayLike, grid: geometry.Grid, centre: ArrayLike, radius: float) -> Array:
    """Mean pressure `(*batch)`, Pa, of the nodes of the mask within `radius` (m) of `centre` `(D,)`, m.

    Where none is as near, that of the nearest node of the mask.
    """
    inside = np.flatnonzero(np.asarray(mask, bool))
    distance = np.linalg.norm(grid.nodes().numpy()[inside] - np.asarray(centre, np.float64), axis=1)
    chosen = inside[distance <= max(radius, float(distance.min()))]
    values = np.asarray(pressure, np.float64)
    return values.reshape(*values.shape[: values.ndim - grid.dimension], -1)[..., chosen].mean(-1)


def pressure_difference(
    pressure: ArrayLike, mask: ArrayLike, grid: geometry.Grid, upper: ArrayLike, lower: ArrayLike, radius: float
) -> Array:
    """Pressure around `upper` less that around `lower` (points `(D,)`, m), Pa: `(*batch)`; see `region_mean`."""
    return region_mean(pressure, mask, grid, upper, radius) - region_mean(pressure, mask, grid, lower, radius)
