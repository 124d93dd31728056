"""Looking up several grid fields at many points, between two moments, in one pass over memory."""

from __future__ import annotations

import torch
from torch import Tensor

from geometry import Grid


class LookUp:
    """Fields at two moments on one grid, read together by multilinear interpolation in space and linear in time.

    The channels of a node lie side by side, so that a point reads whole rows; ``grid_sample`` walks each channel
    by itself and takes six times as long (3-D, 11 channels, 4,000 points on a CPU).

    Args:
        grid: the nodes. early, late: (C, *shape) at the two moments; the same tensor where nothing changes.
        unit: length of one unit of the points, m.
    """

    def __init__(self, grid: Grid, early: Tensor, late: Tensor, unit: float) -> None:
        self.channels, self.steady = early.shape[0], early is late
        both = early if self.steady else torch.cat([early, late])
        self._table = both.reshape(both.shape[0], -1).T.contiguous()
        self._origin = both.new_tensor(grid.origin) / unit
        self._step = both.new_tensor(grid.spacing) / unit
        counts = grid.shape[::-1]
        self._last = torch.tensor([n - 2 for n in counts], dtype=both.dtype, device=both.device)
        self._strides = [1]
        for n in counts[:-1]:
            self._strides.append(self._strides[-1] * n)

    def at(self, points: Tensor, fraction: Tensor) -> Tensor:
        """Values (N, C) at points (N, D), ``fraction`` (N,) or () of the way from early to late.

        Beyond the grid its edge continues; a point that is not finite gets values that are not finite.
        """
        place = (points - self._origin) / self._step
        finite = torch.nan_to_num(place, nan=0.0, posinf=0.0, neginf=0.0)
        low = torch.minimum(finite.floor().clamp_min(0.0), self._last)
        share = (place - low).clamp(0.0, 1.0)
        node = low[:, 0].to(torch.int64)
        for axis in range(1, points.shape[1]):
            node = node + low[:, axis].to(torch.int64) * self._strides[axis]
        value = self._along(points.shape[1] - 1, node, share)
        if self.steady:
            return value
        weight = fraction[:, None] if fraction.ndim else fraction
        return torch.lerp(value[:, : self.channels], value[:, self.channels :], weight)

    def _along(self, axis: int, node: Tensor, share: Tensor) -> Tensor:
        """Interpolate axes 0 to ``axis`` from the corner ``node`` (N,)."""
        if axis < 0:
            return self._table.index_select(0, node)
        first = self._along(axis - 1, node, share)
        return torch.lerp(first, self._along(axis - 1, node + self._strides[axis], share), share[:, axis : axis + 1])
