"""A regular grid: its nodes, multilinear sampling at points, and the exact adjoint of that sampling.

Grid arrays are indexed `[..., z, y, x]` (`[..., y, x]` in a plane) and a value sits AT its node; points hold
their coordinates in the order x, y, z. Everything is linear in the field, differentiable by torch in field
and points, and runs in the dtype and on the device of what it is given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from geometry.arguments import between, checked, finite

from .given import check_floats, numbers, whole_numbers

OUTSIDE = ("clamp", "zero")
MOST_NODES = 2_000_000_000  # whose places fill some 50 GB


class Stencil(NamedTuple):
    """The 2^D nodes around each point: flat node numbers and weights, both `(*batch, n, 2^D)`."""

    index: Tensor  # type: ignore[assignment]  # a tuple has a method of this name, which nothing here calls
    weight: Tensor


@dataclass(frozen=True)
class Grid:
    """Nodes at `origin + spacing * (i, j, k)`.

    Args:
        origin: (D,), m, x first.
        spacing: (D,), m, x first.
        shape: nodes in array order, (nz, ny, nx).

    Raises:
        ValueError: lengths that disagree, a spacing that is not positive, an axis without a node.
    """

    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    shape: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", numbers("Grid: origin", self.origin))
        object.__setattr__(self, "spacing", numbers("Grid: spacing", self.spacing))
        object.__setattr__(self, "shape", whole_numbers("Grid: shape", self.shape))
        if not len(self.origin) == len(self.spacing) == len(self.shape) or len(self.shape) not in (2, 3):
            raise ValueError(
                f"Grid: origin, spacing and shape must all have 2 or all have 3 numbers, "
                f"not {len(self.origin)}, {len(self.spacing)} and {len(self.shape)}"
            )
        if not all(value > 0 for value in self.spacing):
            raise ValueError(f"Grid: spacing must be positive and finite (metres), not {self.spacing}")
        if not all(value >= 1 for value in self.shape):
            raise ValueError(f"Grid: every axis needs at least one node, not shape {self.shape}")

    @classmethod
    @checked
    def covering(cls, lower: Sequence[float], upper: Sequence[float], spacing: float | Sequence[float]) -> Grid:
        """The smallest grid of this spacing (m) from `lower` that reaches `upper` (D numbers each, m)."""
        lower, upper = numbers("Grid.covering: lower", lower), numbers("Grid.covering: upper", upper)
        each = (spacing,) * len(lower) if isinstance(spacing, (int, float)) else spacing
        steps = numbers("Grid.covering: spacing", each)
        if not len(lower) == len(upper) == len(steps):
            counts = f"{len(lower)}, {len(upper)} and {len(steps)}"
            raise ValueError(f"Grid.covering: lower, upper and spacing must have as many numbers, not {counts}")
        if not all(step > 0 for step in steps):
            raise ValueError(f"Grid.covering: spacing must be positive, not {spacing}")
        if not all(end >= start for start, end in zip(lower, upper, strict=True)):
            raise ValueError(f"Grid.covering: upper {tuple(upper)} lies below lower {tuple(lower)}")
        # The slack keeps 10 mm / 1 mm at 10 cells although the quotient may round to 10.000000000000002.
        cells = [math.ceil((end - start) / step - 1e-9) for start, end, step in zip(lower, upper, steps, strict=True)]
        return cls(tuple(lower), steps, tuple(max(count, 0) + 1 for count in reversed(cells)))

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of nodes."""
        return math.prod(self.shape)

    @property
    def cell_volume(self) -> float:
        """Volume of one cell, m^3 (area, m^2, in a plane)."""
        return math.prod(self.spacing)

    @property
    def upper(self) -> tuple[float, ...]:
        """The last node, x, y, z (m); the first one is `origin`."""
        counts = reversed(self.shape)
        return tuple(o + s * (n - 1) for o, s, n in zip(self.origin, self.spacing, counts, strict=True))

    @checked
    def axis(
        self, number: int, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
    ) -> Tensor:
        """Node coordinates (m) along axis `number` (0 is x), `(nodes,)`."""
        if not 0 <= number < self.dimension:
            raise ValueError(f"Grid.axis: number must be from 0 (x) to {self.dimension - 1}, got {number}")
        count = self.shape[self.dimension - 1 - number]
        steps = torch.arange(count, dtype=torch.float64, device=device)
        return (self.origin[number] + self.spacing[number] * steps).to(dtype)

    @checked
    def nodes(self, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
        """All nodes as points `(size, D)`, m, in the order of a flattened grid array (x fastest)."""
        if self.size > MOST_NODES:
            raise ValueError(f"Grid: shape {self.shape} has more nodes than any computer holds; is its spacing in m?")
        axes = [self.axis(number, dtype=dtype, device=device) for number in range(self.dimension)]
        mesh = torch.meshgrid(*reversed(axes), indexing="ij")
        return torch.stack([coordinate.reshape(-1) for coordinate in reversed(mesh)], dim=-1)

    @checked
    def locate(self, points: Tensor) -> Tensor:
        """Points `(*batch, n, D)` in units of nodes from the origin, x, y, z."""
        self._check_points(points)
        return (points - points.new_tensor(self.origin)) / points.new_tensor(self.spacing)

    @checked
    def contains(self, points: Tensor, *, margin: float = 0.0) -> Tensor:
        """Whether points `(*batch, n, D)` lie in the box grown by `margin` (m): bool `(*batch, n)`."""
        self._check_points(points)
        (margin,) = numbers("Grid.contains: margin", [margin])
        lower = points.new_tensor(self.origin) - margin
        upper = points.new_tensor(self.upper) + margin
        return ((points >= lower) & (points <= upper)).all(dim=-1)

    @checked
    def stencil(self, points: Tensor, *, outside: str = "clamp") -> Stencil:
        """The nodes and weights that interpolate multilinearly at points `(*batch, n, D)`.

        Outside the box, `clamp` takes the value at the nearest point of the box and `zero` gives weights of
        zero. A stencil can be kept and passed to `sample` and `spread` for as long as the points stay where
        they are.
        """
        if outside not in OUTSIDE:
            raise ValueError(f"Grid.stencil: outside must be one of {OUTSIDE}, not {outside!r}")
        place = self.locate(points)
        last = place.new_tensor([count - 1 for count in reversed(self.shape)])
        place = torch.minimum(place.clamp(min=0), last)
        lower = torch.minimum(place.detach().floor(), (last - 1).clamp(min=0))
        # A point that is not finite gets the first node's number and weights that are not finite either.
        first = (lower.nan_to_num(0.0).long() * self._strides(place)).sum(dim=-1, keepdim=True)
        weight = self._weights(place - lower)
        if outside == "zero":
            weight = weight * self.contains(points).unsqueeze(-1)
        return Stencil(first + self._offsets(place), weight)

    @checked
    def sample(self, field: Tensor, points: Tensor | Stencil, *, outside: str = "clamp") -> Tensor:
        """Multilinear interpolation of `field (*lead, *shape)` at points: `(*lead, n)`.

        NaN at a node that a point touches, or in the point, comes out as NaN: a particle or a member that has failed
        spoils its own values alone.

        Args:
            field: (*lead, *shape).
            points: (n, D), m, shared by all leading axes, or (*batch, n, D) where batch are the first leading axes of
                the field; or the `Stencil` of such points.
            outside: as in `stencil`.

        Raises:
            ValueError: shapes that do not fit.
        """
        lead = self._lead(field)
        stencil = points if isinstance(points, Stencil) else self.stencil(points, outside=outside)
        batch, count, index, weight = self._flat(stencil, lead)
        # Node after node with its components side by side: the order in which the look-up reads memory.
        rows = field.reshape(batch, -1, self.size).transpose(1, 2).reshape(batch * self.size, -1)
        rows = rows.contiguous()  # a single field comes as a view, which the look-up reads much slower
        result = embedding_bag(index, rows, per_sample_weights=weight.to(rows.dtype), mode="sum")
        return result.reshape(batch, count, rows.shape[1]).transpose(1, 2).reshape(*lead, count)

    @checked(values=finite())
    def spread(self, values: Tensor, points: Tensor | Stencil, *, outside: str = "clamp") -> Tensor:
        """The exact adjoint of `sample`: `values (*lead, n)` added to the nodes around: `(*lead, *shape)`.

        `<spread(a), b> = <a, sample(b)>` for every a and b. No division by the cell volume takes place.

        Raises:
            ValueError: shapes that do not fit, values or points that are not finite.
        """
        check_floats("Grid.spread: values", values)
        lead = tuple(values.shape[:-1])
        stencil = points if isinstance(points, Stencil) else self.stencil(points, outside=outside)
        if not bool(torch.isfinite(stencil.weight).all()):
            raise ValueError("Grid.spread: points must be finite")
        if values.ndim == 0 or values.shape[-1] != stencil.index.shape[-2]:
            raise ValueError(f"Grid.spread: {tuple(values.shape)} values for {stencil.index.shape[-2]} points")
        batch, count, index, weight = self._flat(stencil, lead)
        channels = math.prod(lead[stencil.index.ndim - 2 :])
        rows = values.reshape(batch, channels, count).transpose(1, 2).reshape(batch * count, channels)
        total = values.new_zeros(batch * self.size, rows.shape[1])
        # One corner at a time: all 2^D at once would need 2^D times the memory.
        for corner in range(index.shape[1]):
            total = total.index_add(0, index[:, corner], rows * weight[:, corner, None].to(rows.dtype))
        return total.reshape(batch, self.size, channels).transpose(1, 2).reshape(*lead, *self.shape)

    @checked
    def refined(self, spacing: float | Sequence[float]) -> Grid:
        """A grid of another spacing (m) from the same origin that covers the same box."""
        return Grid.covering(self.origin, self.upper, spacing)

    @checked(nodes=between(-(10**6), 10**6))
    def padded(self, nodes: int) -> Grid:
        """The same grid with `nodes` more nodes on every side (fewer where negative)."""
        (nodes,) = whole_numbers("Grid.padded: nodes", [nodes])
        origin = tuple(start - nodes * step for start, step in zip(self.origin, self.spacing, strict=True))
        return Grid(origin, self.spacing, tuple(count + 2 * nodes for count in self.shape))

    def _strides(self, like: Tensor) -> Tensor:
        """Flat distance of neighbours along x, y, z; 0 along an axis of a single node."""
        strides = [math.prod(self.shape[self.dimension - axis :]) for axis in range(self.dimension)]
        single = [count == 1 for count in reversed(self.shape)]
        numbers = [0 if alone else stride for stride, alone in zip(strides, single, strict=True)]
        return torch.tensor(numbers, device=like.device)

    def _offsets(self, like: Tensor) -> Tensor:
        """Flat distance of the 2^D corners of a cell from its first one, x changing slowest."""
        corners = torch.tensor(list(product((0, 1), repeat=self.dimension)), device=like.device)
        return (corners * self._strides(like)).sum(dim=1)

    @staticmethod
    def _weights(fraction: Tensor) -> Tensor:
        """Weights `(..., 2^D)` of the corners for places `(..., D)` in a cell, in the order of `_offsets`."""
        weights = [torch.ones_like(fraction[..., 0])]
        for part in fraction.unbind(dim=-1):
            weights = [weight * factor for weight in weights for factor in (1 - part, part)]
        return torch.stack(weights, dim=-1)

    def _flat(self, stencil: Stencil, lead: tuple[int, ...]) -> tuple[int, int, Tensor, Tensor]:
        """Fields with points of their own, points of each, and node numbers and weights in one list."""
        axes = tuple(stencil.index.shape[:-2])
        if lead[: len(axes)] != axes:
            raise ValueError(f"Grid: points with batch {axes} do not fit leading axes {lead}")
        batch, (count, corners) = math.prod(axes), stencil.index.shape[-2:]
        shift = self.size * torch.arange(batch, device=stencil.index.device)
        index = stencil.index.reshape(batch, -1) + shift[:, None]
        return batch, count, index.reshape(-1, corners), stencil.weight.reshape(-1, corners)

    def _check_points(self, points: Tensor) -> None:
        check_floats("Grid: points", points)
        if points.ndim < 2 or points.shape[-1] != self.dimension:
            raise ValueError(f"Grid: points must be (..., n, {self.dimension}), not {tuple(points.shape)}")

    def _lead(self, field: Tensor) -> tuple[int, ...]:
        check_floats("Grid.sample: the field", field)
        if tuple(field.shape[field.ndim - self.dimension :]) != self.shape or field.ndim < self.dimension:
            raise ValueError(f"Grid.sample: the field's last axes must be {self.shape}, not {tuple(field.shape)}")
        return tuple(field.shape[: field.ndim - self.dimension])
