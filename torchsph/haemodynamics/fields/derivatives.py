"""Derivatives in space of a velocity that is known at the nodes of a mask and at points of the wall around it.

Inside, where a node has both neighbours along every axis: second-order central differences and the compact Laplacian.
At the border of the mask there is nothing on the other side: there a quadratic polynomial is fitted to the nodes of the
mask and the points of the wall around, and differentiated (`polynomial_fit`). The wall's own velocity is as good a
sample of the flow as a node's: blood sticks to it. Where the neighbours do not determine a quadratic a linear
polynomial is fitted; along a direction without any neighbour the derivative is 0, and the node counts in `unresolved`.

All is linear in the velocity, so that one `Derivatives` serves every member of an ensemble in a frame. Where there is a
spline its own derivatives are exact and take the place of these: everything in this room that needs a gradient takes
the gradient itself.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

import geometry

from .polynomial_fit import derivative_coefficients

__all__ = ["Derivatives", "WallSamples"]

Array = NDArray[np.float64]


class WallSamples(NamedTuple):
    """Points of the wall `(n, D)`, m, and the velocity of the blood there, which is the wall's, `(n, D)`, m/s."""

    points: Array
    velocities: Array

    @classmethod
    def at(cls, sampler: geometry.WallSampler, t: float) -> WallSamples:
        """The points of `sampler` at time `t`, s, without those of orifices (regions above 0)."""
        return cls.of(sampler.at(t))

    @classmethod
    def of(cls, found: geometry.WallPoints) -> WallSamples:
        """The points of the wall among those `found`, without those of orifices (regions above 0)."""
        wall = found.region == 0
        return cls(found.points[wall], found.velocities[wall])


class _Operators(NamedTuple):
    gradient: tuple[csr_array, ...]  # D of (nodes, samples)
    laplacian: csr_array
    unresolved: int


class Derivatives:
    """Gradient, divergence and Laplacian on the nodes of one mask.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`, the nodes in the blood.
        wall: points of the wall at the same time; `None`: nothing is known of the wall.

    Raises:
        ValueError: the mask does not lie on the grid.
    """

    def __init__(self, grid: geometry.Grid, mask: ArrayLike, wall: WallSamples | None = None) -> None:
        self.grid, self.mask = grid, np.asarray(mask, bool)
        if self.mask.shape != grid.shape:
            raise ValueError(f"Derivatives: the mask must be {grid.shape} as the grid, not {self.mask.shape}")
        self.wall = wall
        self.nodes = np.flatnonzero(self.mask)

    @property
    def unresolved(self) -> int:
        """Nodes at which a derivative along some direction is not determined and was set to 0."""
        return self._operators.unresolved

    def gradient(self, velocity: ArrayLike) -> Array:
        """Velocity gradient `(*batch, D, D, *shape)`, 1/s: [i, j] = du_i / dx_j; 0 outside the mask.

        Args:
            velocity: `(*batch, D, *shape)`, m/s.
        """
        values, lead = self._values(velocity)
        parts = [self._onto_grid(operator @ values, lead) for operator in self._operators.gradient]
        return np.stack(parts, axis=-1 - self.grid.dimension)

    def divergence(self, velocity: ArrayLike) -> Array:
        """Divergence `(*batch, *shape)`, 1/s, of `velocity` `(*batch, D, *shape)`, m/s."""
        return np.trace(self.gradient(velocity), axis1=-2 - self.grid.dimension, axis2=-1 - self.grid.dimension)

    def laplacian(self, velocity: ArrayLike) -> Array:
        """Laplacian of every component `(*batch, D, *shape)`, 1/(m s), of `velocity` `(*batch, D, *shape)`, m/s.

        Second order inside, first order at the border.
        """
        values, lead = self._values(velocity)
        return self._onto_grid(self._operators.laplacian @ values, lead)

    def _lead(self, velocity: ArrayLike) -> tuple[int, ...]:
        return tuple(np.shape(velocity)[: -1 - self.grid.dimension])

    def _values(self, velocity: ArrayLike) -> tuple[Array, tuple[int, ...]]:
        """The samples `(nodes + wall points, batch * D)` and the batch axes."""
        array = np.asarray(velocity)
        expected = (self.grid.dimension, *self.grid.shape)
        if array.shape[-1 - self.grid.dimension :] != expected:
            raise ValueError(f"Derivatives: the velocity must be (..., {expected}), not {array.shape}")
        lead = self._lead(array)
        values = array.reshape(-1, self.grid.size)[:, self.nodes].T.astype(np.float64)
        if self.wall is not None:
            repeats = values.shape[1] // self.grid.dimension
            values = np.concatenate([values, np.tile(self.wall.velocities, (1, repeats))])
        return values, lead

    def _onto_grid(self, values: Array, lead: tuple[int, ...]) -> Array:
        result = np.zeros((values.shape[1], self.grid.size))
        result[:, self.nodes] = values.T
        return result.reshape(*lead, self.grid.dimension, *self.grid.shape)

    @cached_property
    def _operators(self) -> _Operators:
        number = np.full(self.grid.size, -1)
        number[self.nodes] = np.arange(len(self.nodes))
        padded = np.pad(number.reshape(self.grid.shape), 1, constant_values=-1)
        index = np.stack(np.unravel_index(self.nodes, self.grid.shape)) + 1
        before, after = (self._neighbours(padded, index, step) for step in (-1, 1))
        inside = np.all((before >= 0) & (after >= 0), axis=0)
        border = _border_rows(self, np.flatnonzero(~inside))
        return self._assembled(inside, before, after, border)

    def _neighbours(self, padded: NDArray[np.int64], index: NDArray[np.int64], step: int) -> NDArray[np.int64]:
        """Numbers of the neighbours along x, y, z, `(D, nodes)`; -1 where there is none in the mask."""
        shifts = np.eye(self.grid.dimension, dtype=np.int64)[::-1] * step  # row x moves the last array axis
        return np.stack([padded[tuple(index + shift[:, None])] for shift in shifts])

    def _assembled(
        self, inside: NDArray[np.bool_], before: NDArray[np.int64], after: NDArray[np.int64], border: _BorderRows
    ) -> _Operators:
        rows = np.flatnonzero(inside)
        columns = len(self.nodes) + (0 if self.wall is None else len(self.wall.points))
        shape, gradient, second = (len(self.nodes), columns), [], border.laplacian
        for axis, step in enumerate(self.grid.spacing):
            low, high = before[axis][rows], after[axis][rows]
            central = _entries((rows, high, 0.5 / step), (rows, low, -0.5 / step), shape=shape)
            gradient.append(central + border.gradient[axis])
            per_area = 1 / step**2
            second = second + _entries(
                (rows, high, per_area), (rows, low, per_area), (rows, rows, -2 * per_area), shape=shape
            )
        return _Operators(tuple(gradient), second, border.unresolved)


class _BorderRows(NamedTuple):
    gradient: tuple[csr_array, ...]
    laplacian: csr_array
    unresolved: int


def _border_rows(of: Derivatives, rows: NDArray[np.int64]) -> _BorderRows:
    """The rows of the border nodes `rows`, from fits to the nodes and wall points around."""
    nodes = of.grid.nodes().numpy()[of.nodes]
    samples = nodes if of.wall is None else np.concatenate([nodes, of.wall.points])
    fit = derivative_coefficients(nodes[rows], samples, np.asarray(of.grid.spacing))
    shape = (len(nodes), len(samples))
    there, row = fit.number >= 0, np.broadcast_to(rows[:, None], fit.number.shape)

    def matrix(values: Array) -> csr_array:
        return csr_array((values[there], (row[there], fit.number[there])), shape=shape)

    gradient = tuple(matrix(fit.gradient[..., axis]) for axis in range(of.grid.dimension))
    return _BorderRows(gradient, matrix(fit.laplacian), int((fit.rank == 0).sum()))


def _entries(*parts: tuple[NDArray[np.int64], NDArray[np.int64], float], shape: tuple[int, int]) -> csr_array:
    row, column = (np.concatenate([part[place] for part in parts]) for place in (0, 1))
    value = np.concatenate([np.full(len(rows), factor) for rows, _, factor in parts])
    return csr_array((value, (row, column)), shape=shape)
