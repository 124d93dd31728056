"""The tensor-product knot grid: where a point falls, which coefficients it touches, with which values."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch

from regularize.arguments import checked
from regularize.errors import InvalidInput

from .bspline import DEGREES, basis_at

MOST_NODES = 2**31 - 1  # places of coefficients are int32 in compiled code


@checked
@dataclass(frozen=True)
class Knots:
    """Uniform knots in A axes (space, and time as a last axis), all tuples in the order x, y, (z), (t).

    ``origin`` (m, last axis s where it is time) is the lower corner, ``spacing`` the knot distance, ``cells``
    the number of intervals. Each axis carries cells + degree coefficients. Coefficient fields are stored as
    arrays [..., z, y, x], the convention of the recordings.
    """

    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    cells: tuple[int, ...]
    degree: int = 3

    def __post_init__(self) -> None:
        if self.degree not in DEGREES:
            raise InvalidInput(f"degree is {self.degree}: it must be one of {DEGREES}")
        if not len(self.origin) == len(self.spacing) == len(self.cells):
            raise InvalidInput("origin, spacing and cells must have one entry per axis")
        for name, values in (("origin", self.origin), ("spacing", self.spacing), ("cells", self.cells)):
            if not all(isinstance(value, int | float | np.number) for value in values):
                raise InvalidInput(f"{name} is {values!r:.80}: it must hold numbers")
        if not all(0 < step < math.inf for step in self.spacing) or not all(map(math.isfinite, self.origin)):
            raise InvalidInput(
                f"spacing is {self.spacing}, origin {self.origin}: knot distances must be positive, and all finite"
            )
        if min(self.cells) < 1:
            raise InvalidInput(f"cells is {self.cells}: at least one interval per axis is needed")
        if self.nodes > MOST_NODES:
            raise InvalidInput(
                f"knots of {self.spacing} in {self.cells} cells ask for more than the {MOST_NODES} unknowns that "
                "int32 can number: give a larger knot distance (it is in m)"
            )

    @classmethod
    @checked
    def covering(
        cls, lower: Sequence[float], upper: Sequence[float], spacing: Sequence[float], degree: int = 3
    ) -> "Knots":
        """The smallest grid of the given spacing around the box, centred on it."""
        if not len(lower) == len(upper) == len(spacing) or not len(spacing):
            counts = f"{len(lower)}, {len(upper)} and {len(spacing)}"
            raise InvalidInput(f"lower, upper and spacing must have one number per axis each, not {counts}")
        if not all(0 < h < math.inf for h in spacing) or not all(map(math.isfinite, (*lower, *upper))):
            raise InvalidInput(f"spacing is {tuple(spacing)}: knot distances must be positive, and all finite")
        # The small slack keeps a box of exactly k intervals from getting k + 1 of them by round-off.
        cells = tuple(max(1, _ceil((b - a) / h - 1e-9)) for a, b, h in zip(lower, upper, spacing, strict=True))
        origin = tuple((a + b - n * h) / 2 for a, b, h, n in zip(lower, upper, spacing, cells, strict=True))
        return cls(origin, tuple(float(h) for h in spacing), cells, degree)

    def spread_out(self, factor: float) -> "Knots":
        """Knots over the same box, ``factor`` times as far apart."""
        upper = [o + h * n for o, h, n in zip(self.origin, self.spacing, self.cells, strict=True)]
        return Knots.covering(self.origin, upper, [factor * h for h in self.spacing], self.degree)

    @property
    def axes(self) -> int:
        """A."""
        return len(self.cells)

    @property
    def shape(self) -> tuple[int, ...]:
        """Coefficients per axis in array order (..., z, y, x)."""
        return tuple(n + self.degree for n in reversed(self.cells))

    @property
    def nodes(self) -> int:
        """Number of coefficients of a component."""
        return reduce(lambda a, b: a * b, self.shape, 1)

    @property
    def local_size(self) -> int:
        """Coefficients that one point touches: (degree + 1) ** axes."""
        return (self.degree + 1) ** self.axes

    @checked
    def inside(self, points: torch.Tensor) -> torch.Tensor:
        """(n,) bool: which points (n, A) lie in the box, its faces included up to round-off."""
        u = self._scaled(points)
        # Round-off of float32 coordinates is about 1e-7 of the box; a point on the face must not fall out.
        slack = 1e-6 * max(self.cells)
        upper = torch.tensor(self.cells, dtype=u.dtype, device=u.device)
        return ((u >= -slack) & (u <= upper + slack)).all(dim=-1)

    @checked
    def locate(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Cell index (n, A) int64 and local coordinate (n, A) in [0, 1] of points (n, A).

        Points outside are moved onto the nearest face; ask :meth:`inside` first.
        """
        u = self._scaled(points)
        upper = torch.tensor(self.cells, dtype=u.dtype, device=u.device)
        u = torch.minimum(u.clamp(min=0), upper)
        cell = torch.minimum(u.floor(), upper - 1)
        return cell.long(), u - cell

    def stencil(self, t: torch.Tensor, orders: Sequence[int] | None = None) -> torch.Tensor:
        """Products (n, local_size) of 1-D values at local coordinates t (n, A), derivatives per metre.

        ``orders`` gives the derivative order per axis (x first). The last array axis (x) varies fastest.
        """
        orders = (0,) * self.axes if orders is None else tuple(orders)
        product = torch.ones(len(t), 1, dtype=t.dtype, device=t.device)
        for axis in reversed(range(self.axes)):
            values = basis_at(t[:, axis], self.degree, orders[axis]) / self.spacing[axis] ** orders[axis]
            product = (product[:, :, None] * values[:, None, :]).flatten(1)
        return product

    def cell_number(self, cell: torch.Tensor) -> torch.Tensor:
        """Flat number (n,) of cells (n, A), x fastest."""
        number = torch.zeros(cell.shape[:-1], dtype=torch.int64, device=cell.device)
        for axis in reversed(range(self.axes)):
            number = number * self.cells[axis] + cell[..., axis]
        return number

    def cell_index(self, number: torch.Tensor) -> torch.Tensor:
        """(n, A) cells of flat numbers (n,)."""
        columns = []
        for axis in range(self.axes):
            columns.append(number % self.cells[axis])
            number = number // self.cells[axis]
        return torch.stack(columns, dim=-1)

    def local_nodes(self, cell: torch.Tensor) -> torch.Tensor:
        """Flat coefficient numbers (n, local_size) that cells (n, A) touch, as in :meth:`stencil`."""
        steps = torch.arange(self.degree + 1, device=cell.device)
        flat = torch.zeros(len(cell), 1, dtype=torch.int64, device=cell.device)
        for axis in reversed(range(self.axes)):
            along = cell[:, axis, None] + steps
            flat = (flat[:, :, None] * (self.cells[axis] + self.degree) + along[:, None, :]).flatten(1)
        return flat

    def _scaled(self, points: torch.Tensor) -> torch.Tensor:
        origin = torch.tensor(self.origin, dtype=points.dtype, device=points.device)
        spacing = torch.tensor(self.spacing, dtype=points.dtype, device=points.device)
        return (points - origin) / spacing


def _ceil(value: float) -> int:
    return int(-(-value // 1))
