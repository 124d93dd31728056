"""Looking up several grid fields at many points, between two times, in one pass over memory."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from copy import copy

import torch
from torch import Tensor
from torch.nn import functional

from geometry import Grid
from torchsph.native.library import REALS, LibraryMissing, library
from torchsph.native.structures import LookUpArguments


class LookUp:
    """Fields at two times on one grid, read together by multilinear interpolation in space and linear in time.

    The channels of a node lie side by side, so that a point reads whole rows: by compiled code where there is some
    and no derivative is asked for (16,800 points of a sphere, 11 channels, one core: 1 ms), else by torch (3 ms).

    Args:
        grid: the nodes, two or more along each axis.
        early: (C, *shape), at the first of the two times.
        late: (C, *shape), at the second; ``early`` itself where nothing changes.
        unit: length of one unit of the points, m.
        plain: cells where the first channel exceeds this at every corner and time need no interpolation: compiled
            code gives them the early values of their lowest corner, which costs a tenth. None: no such cells.
        directed: whether channels 1 to D are a direction, given with length 1.
    """

    def __init__(
        self,
        grid: Grid,
        early: Tensor,
        late: Tensor,
        unit: float,
        plain: float | None = None,
        *,
        directed: bool = False,
    ) -> None:
        self.channels, self.steady, self._directed = early.shape[0], early is late, directed
        self._rows = [rows_of(field) for field in ([early] if self.steady else [early, late])]
        self._plain = None if plain is None or early.is_cuda else _cells_above(torch.minimum(early[0], late[0]), plain)
        self._function = _compiled_function(self._rows[0])
        self._both: Tensor | None = None  # both times side by side, for torch
        self._counts = grid.shape[::-1]
        self._origin = [value / unit for value in grid.origin]
        self._step = [value / unit for value in grid.spacing]
        self._place = [early.new_tensor(values) for values in (self._origin, self._step, [n - 2 for n in self._counts])]

    @property
    def variable(self) -> Tensor | None:
        """(nodes, channels of both times), where torch is to differentiate the fields; None where it is not."""
        if not any(rows.requires_grad for rows in self._rows):
            return None
        return self._side_by_side()

    def with_variable(self, rows: Tensor) -> LookUp:
        """The same look-up of other fields, given as ``variable`` has them."""
        other = copy(self)
        other._rows, other._both = [rows], rows
        return other

    def at(self, points: Tensor, fraction: Tensor) -> Tensor:
        """Values at points.

        Beyond the grid its edge continues; a point that is not finite gets values that are not finite.

        Args:
            points: (N, D).
            fraction: (N,) or (), of the time from early to late.

        Returns:
            (N, C).
        """
        derived = torch.is_grad_enabled() and any(t.requires_grad for t in (points, fraction, *self._rows))
        alike = points.device.type == "cpu" and points.dtype == self._rows[0].dtype
        if self._function is not None and alike and not derived:
            return self._compiled(self._function, points, fraction)
        values = self._by_torch(points, fraction)
        if not self._directed:
            return values
        last = 1 + points.shape[1]
        return torch.cat([values[:, :1], functional.normalize(values[:, 1:last], dim=1), values[:, last:]], 1)

    def _compiled(self, function: Callable[[object], int], points: Tensor, fraction: Tensor) -> Tensor:
        points, fraction = points.contiguous(), fraction.to(points.dtype).contiguous()
        out = points.new_empty((points.shape[0], self.channels))
        triple, dimension = ctypes.c_double * 3, points.shape[1]
        function(
            ctypes.byref(
                LookUpArguments(
                    dimension=dimension,
                    threads=torch.get_num_threads(),
                    channels=self.channels,
                    count=points.shape[0],
                    fractions=fraction.numel(),
                    early=self._rows[0].data_ptr(),
                    late=None if self.steady else self._rows[1].data_ptr(),
                    plain=None if self._plain is None else self._plain.data_ptr(),
                    points=points.data_ptr(),
                    fraction=fraction.data_ptr(),
                    origin=triple(*self._origin),
                    step=triple(*self._step),
                    counts=(ctypes.c_int64 * 3)(*self._counts),
                    unit=self._directed,
                    out=out.data_ptr(),
                )
            )
        )
        return out

    def _side_by_side(self) -> Tensor:
        if self._both is None:
            self._both = self._rows[0] if self.steady else torch.cat(self._rows, 1)
        return self._both

    def _by_torch(self, points: Tensor, fraction: Tensor) -> Tensor:
        origin, step, last = self._place
        place = (points - origin) / step
        finite = torch.nan_to_num(place, nan=0.0, posinf=0.0, neginf=0.0)
        low = torch.minimum(finite.floor().clamp_min(0.0), last)
        share = (place - low).clamp(0.0, 1.0)
        node = low[:, 0].to(torch.int64)
        strides = [1]
        for axis in range(1, points.shape[1]):
            strides.append(strides[-1] * self._counts[axis - 1])
            node = node + low[:, axis].to(torch.int64) * strides[axis]
        value = self._along(self._side_by_side(), points.shape[1] - 1, node, share, strides)
        if self.steady:
            return value
        weight = fraction[:, None] if fraction.ndim else fraction
        return torch.lerp(value[:, : self.channels], value[:, self.channels :], weight)

    def _along(self, rows: Tensor, axis: int, node: Tensor, share: Tensor, strides: list[int]) -> Tensor:
        """Interpolate ``rows`` (nodes, C) along axes 0 to ``axis`` from the corner ``node`` (N,)."""
        if axis < 0:
            return rows.index_select(0, node)
        first = self._along(rows, axis - 1, node, share, strides)
        second = self._along(rows, axis - 1, node + strides[axis], share, strides)
        return torch.lerp(first, second, share[:, axis : axis + 1])


def _compiled_function(rows: Tensor) -> Callable[[object], int] | None:
    """Compiled look-up for rows of this type and place; None where there is none, and torch has to do."""
    if rows.device.type != "cpu" or rows.dtype not in REALS:
        return None
    try:
        return library().function("look_up", REALS[rows.dtype])
    except LibraryMissing:
        return None


def _cells_above(value: Tensor, bound: float) -> Tensor:
    """Which cells of (*shape), by their lowest corner, have all corners above a bound: (nodes,) bool."""
    above = value > bound
    for axis in range(above.ndim):
        length = above.shape[axis]
        # a node without a next one starts no cell that a look-up uses
        below = above.narrow(axis, 0, length - 1) & above.narrow(axis, 1, length - 1)
        above = torch.cat([below, above.narrow(axis, length - 1, 1)], axis)
    return above.reshape(-1).contiguous()


def rows_of(field: Tensor) -> Tensor:
    """A field (C, *shape) as (nodes, C), contiguous: a view where it lies like this in memory (``by_node``)."""
    return field.reshape(field.shape[0], -1).T.contiguous()


def by_node(field: Tensor) -> Tensor:
    """A field (C, *shape), unchanged but laid out in memory with the channels of a node side by side."""
    return rows_of(field).T.reshape(field.shape)
