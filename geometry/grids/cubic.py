"""Cubic splines through the values of a field on a grid: what linear interpolation smooths away stays."""

from __future__ import annotations

import torch
from torch import Tensor

from geometry.arguments import checked

from .grid import Grid


class CubicInterpolation:
    """The cubic B-spline that meets a field at all nodes, mirrored about the grid's outermost ones.

    The coefficients are found once, so that the same field can be asked for at many sets of points (M. Unser, IEEE
    Signal Process. Mag. 16 (1999) 22, eqs. 9 and 17; `scipy.ndimage.map_coordinates` with mode "mirror" is the same).

    Args:
        grid: the nodes.
        field: (*lead, *shape), without NaN: the spline would carry one to every node.

    Raises:
        ValueError: a field of another shape than the grid's.
    """

    @checked
    def __init__(self, grid: Grid, field: Tensor) -> None:
        if field.shape[field.ndim - grid.dimension :] != grid.shape:
            raise ValueError(f"CubicInterpolation: field must end in the grid's {grid.shape}, not {tuple(field.shape)}")
        self.grid, self.coefficients = grid, field
        for axis, count in enumerate(grid.shape, field.ndim - grid.dimension):
            solve = torch.linalg.inv(_values_from_coefficients(count)).to(field)
            self.coefficients = torch.tensordot(self.coefficients, solve, dims=([axis], [1])).movedim(-1, axis)

    @checked
    def at(self, points: Tensor) -> Tensor:
        """Values (*lead, n) at points (n, D), m; beyond the grid's box those at the nearest point of the box."""
        shape, dimension = self.grid.shape, self.grid.dimension
        last = points.new_tensor([count - 1 for count in reversed(shape)])
        place = torch.minimum(self.grid.locate(points).clamp(min=0), last)
        lower = place.floor()
        weights = _weights(place - lower)
        lead = self.coefficients.shape[: self.coefficients.ndim - dimension]
        rows = self.coefficients.reshape(-1, self.grid.size).T.contiguous()
        index = torch.zeros((len(points), 1), dtype=torch.int64, device=points.device)
        weight = points.new_ones((len(points), 1))
        for axis in reversed(range(dimension)):  # array order, x last
            count = shape[dimension - 1 - axis]
            node = _mirrored(lower[:, axis].long()[:, None] + torch.arange(-1, 3, device=points.device), count)
            index = (index[:, :, None] * count + node[:, None, :]).flatten(1)
            weight = (weight[:, :, None] * weights[:, axis, None, :]).flatten(1)
        found = torch.nn.functional.embedding_bag(index, rows, per_sample_weights=weight.to(rows.dtype), mode="sum")
        return found.T.reshape(*lead, len(points))


def _weights(fraction: Tensor) -> Tensor:
    """(n, D, 4) weights of the coefficients at -1, 0, 1 and 2 for points ``fraction`` (n, D) beyond node 0."""
    other = 1 - fraction
    inner = [2 / 3 - part.square() * (2 - part) / 2 for part in (fraction, other)]
    return torch.stack([other**3 / 6, *inner, fraction**3 / 6], -1)


def _mirrored(node: Tensor, count: int) -> Tensor:
    """Nodes beyond either end as they are seen in a mirror on the outermost node."""
    if count == 1:
        return torch.zeros_like(node)
    node = node.abs() % (2 * (count - 1))
    return torch.where(node >= count, 2 * (count - 1) - node, node)


def _values_from_coefficients(count: int) -> Tensor:
    """(count, count): what the spline of given coefficients is at the nodes."""
    matrix = torch.zeros((count, count), dtype=torch.float64)
    row = torch.arange(count)
    for offset, weight in ((-1, 1 / 6), (0, 2 / 3), (1, 1 / 6)):
        matrix.index_put_((row, _mirrored(row + offset, count)), torch.tensor(weight, dtype=torch.float64), True)
    return matrix
