"""Linear rows of the spline system, matrix-free, each with its exact adjoint.

A coefficient vector is a tensor (nodes, C) for C velocity components. Every row block maps it to its rows
and back; blocks are stacked by :class:`System` into the matrix of Grønli 2017, eq. 3.22. Rows, not squared terms,
are scaled: a row of weight w contributes w^2 to the cost (our reading of Grønli 2017, eq. 3.10 and eq. 3.16).
"""

import math
from collections.abc import Iterator, Sequence
from functools import reduce
from typing import Protocol

import torch

from regularize.arguments import Rule, checked
from regularize.basis.knots import Knots
from regularize.errors import InvalidInput

from .given import check_real

PLACES = Rule("of the shape (n, A)", lambda points: points.ndim == 2)
CHUNK = 4096  # points per pass: bounds the (points, local_size, C) buffers to a few megabytes


class RowBlock(Protocol):
    """What the solvers ask of a set of rows, each of which lives in one knot cell.

    Args:
        knots: the grid of the coefficients.
        components: C of the field.
        cell: (groups, A), the cells of the rows, one or more rows each.
        target: (rows,), right-hand side, already weighted.
    """

    knots: Knots
    components: int
    cell: torch.Tensor
    target: torch.Tensor

    def matvec(self, c: torch.Tensor) -> torch.Tensor:
        """(nodes, C) -> (rows,)."""

    def rmatvec(self, r: torch.Tensor) -> torch.Tensor:
        """(rows,) -> (nodes, C), the exact adjoint of :meth:`matvec`."""


class PointRows:
    """Shared bookkeeping of rows that live at points inside the knot box.

    Args:
        knots: the grid.
        points: (n, A), m (and s).
        components: C of the field.
    """

    weight: torch.Tensor  # (n, C) or (n,), row factors
    target: torch.Tensor  # (rows,), already weighted

    def __init__(self, knots: Knots, points: torch.Tensor, components: int) -> None:
        check_real("points", points)
        if points.ndim != 2 or points.shape[1] != knots.axes:
            raise InvalidInput(f"points have shape {tuple(points.shape)}: expected (n, {knots.axes})")
        if not bool(torch.isfinite(points).all()):
            raise InvalidInput("points must be finite: leave out those that are not")
        self.knots, self.components = knots, components
        self.cell, self.t = knots.locate(points)

    def __len__(self) -> int:
        return len(self.cell)

    def _chunks(self) -> Iterator[slice]:
        for start in range(0, len(self.cell), CHUNK):
            yield slice(start, min(start + CHUNK, len(self.cell)))

    def rows_at(self, index: slice | torch.Tensor) -> torch.Tensor:
        """(n, local_size, C) values of coupled rows; (n, local_size) of component-wise ones; unweighted."""
        raise NotImplementedError


def at_points(block: "RowBlock") -> PointRows:
    """The same block, which must be one of rows at points; TypeError where an engine meets rows it does not know."""
    if not isinstance(block, PointRows):
        raise TypeError(f"{type(block).__name__} are neither CellRows nor PointRows: no engine knows how to add them")
    return block


class VectorRows(PointRows):
    """Rows w_ik v_k(x_i) = w_ik target_ik, one per point and component (the matrix S of Grønli 2017, eq. 3.7)."""

    @checked(points=PLACES)
    def __init__(self, knots: Knots, points: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> None:
        for name, values in (("points", points), ("target", target), ("weight", weight)):
            check_real(name, values)
        if target.ndim != 2 or len(target) != len(points):
            raise InvalidInput(f"target has the shape {tuple(target.shape)}: it must be ({len(points)}, C)")
        check_real("weight", weight, ((len(target), 1), tuple(target.shape), (1,), ()))
        super().__init__(knots, points, target.shape[1])
        self.weight = weight.expand(target.shape)
        self.target = (self.weight * target).flatten()

    def rows_at(self, index: slice | torch.Tensor) -> torch.Tensor:
        """(n, local_size), the same for every component; unweighted."""
        return self.knots.stencil(self.t[index])

    def matvec(self, c: torch.Tensor) -> torch.Tensor:
        """(nodes, C) -> (n * C,), component fastest."""
        out = torch.empty(len(self), self.components, dtype=c.dtype, device=c.device)
        for part in self._chunks():
            near = c[self.knots.local_nodes(self.cell[part])]
            out[part] = torch.einsum("nl,nlc->nc", self.rows_at(part).to(c.dtype), near)
        return (self.weight.to(c.dtype) * out).flatten()

    def rmatvec(self, r: torch.Tensor) -> torch.Tensor:
        """(n * C,) -> (nodes, C), the exact adjoint."""
        r = self.weight.to(r.dtype) * r.view(len(self), self.components)
        out = torch.zeros(self.knots.nodes, self.components, dtype=r.dtype, device=r.device)
        for part in self._chunks():
            values = self.rows_at(part).to(r.dtype)[:, :, None] * r[part][:, None, :]
            out.index_add_(0, self.knots.local_nodes(self.cell[part]).flatten(), values.flatten(0, 1))
        return out

    def with_target(self, target: torch.Tensor) -> "VectorRows":
        """The same rows for other sample values (n, C)."""
        other = object.__new__(VectorRows)
        other.__dict__.update(self.__dict__)
        other.target = (self.weight * target).flatten()
        return other

    def with_weight(self, factor: torch.Tensor | float) -> "VectorRows":
        """The same rows with all weights multiplied by ``factor``, a number or (n, 1)."""
        other = object.__new__(VectorRows)
        other.__dict__.update(self.__dict__)
        other.weight = self.weight * factor
        other.target = (self.target.view(other.weight.shape) * factor).flatten()
        return other

    def detached(self) -> "VectorRows":
        """The same rows without their autograd graph."""
        other = object.__new__(VectorRows)
        other.__dict__.update(self.__dict__)
        other.weight, other.target = self.weight.detach(), self.target.detach()
        return other

    def with_unit_weight(self) -> "VectorRows":
        """The same points with weight 1 (and no meaningful target)."""
        other = self.detached()
        other.weight = torch.ones_like(other.weight)
        return other

    def repeated(self, count: int) -> "VectorRows":
        """The same rows, of one weight per point, for ``count`` components and no target."""
        other = object.__new__(VectorRows)
        other.__dict__.update(self.__dict__)
        other.components, other.weight = count, self.weight[:, :1].expand(-1, count)
        other.target = torch.zeros(len(self) * count, dtype=self.target.dtype)
        return other

    def component(self, k: int) -> "VectorRows":
        """The rows of one component, as rows of a scalar field."""
        one = object.__new__(VectorRows)
        one.knots, one.components, one.cell, one.t = self.knots, 1, self.cell, self.t
        one.weight = self.weight[:, k : k + 1]
        one.target = self.target.view(len(self), -1)[:, k].clone()
        return one


class _CoupledRows(PointRows):
    """One row per point, touching all components of the local coefficients."""

    def __init__(
        self, knots: Knots, points: torch.Tensor, components: int, target: torch.Tensor, weight: torch.Tensor
    ) -> None:
        super().__init__(knots, points, components)
        check_real("weight", weight, ((len(points),), (1,), ()))
        self.weight = weight.expand(len(points))
        self.target = self.weight * target

    def matvec(self, c: torch.Tensor) -> torch.Tensor:
        out = torch.empty(len(self), dtype=c.dtype, device=c.device)
        for part in self._chunks():
            near = c[self.knots.local_nodes(self.cell[part])]
            out[part] = (self.rows_at(part).to(c.dtype) * near).sum(dim=(1, 2))
        return self.weight.to(c.dtype) * out

    def rmatvec(self, r: torch.Tensor) -> torch.Tensor:
        r = self.weight.to(r.dtype) * r
        out = torch.zeros(self.knots.nodes, self.components, dtype=r.dtype, device=r.device)
        for part in self._chunks():
            values = self.rows_at(part).to(r.dtype) * r[part][:, None, None]
            out.index_add_(0, self.knots.local_nodes(self.cell[part]).flatten(), values.flatten(0, 1))
        return out


class DirectionRows(_CoupledRows):
    """Rows w_i d_i . v(x_i): wall normals (Grønli 2017, eq. 3.21), Doppler beams. direction (n, C), target (n,)."""

    @checked(points=PLACES)
    def __init__(
        self,
        knots: Knots,
        points: torch.Tensor,
        direction: torch.Tensor,
        target: torch.Tensor,
        weight: torch.Tensor,
    ) -> None:
        for name, values in (("points", points), ("direction", direction), ("target", target)):
            check_real(name, values)
        if not bool(torch.isfinite(direction).all()):
            raise InvalidInput("direction must be finite: leave out the rows whose direction is not known")
        if direction.ndim != 2 or len(direction) != len(points) or target.shape != points[:, 0].shape:
            raise InvalidInput(
                f"directions of the shape {tuple(direction.shape)} and targets of {tuple(target.shape)}: they must be "
                f"({len(points)}, C) and ({len(points)},)"
            )
        super().__init__(knots, points, direction.shape[1], target, weight)
        self.direction = direction

    def rows_at(self, index: slice | torch.Tensor) -> torch.Tensor:
        """(n, local_size, C), unweighted."""
        return self.knots.stencil(self.t[index])[:, :, None] * self.direction[index][:, None, :]


class DivergenceRows(_CoupledRows):
    """Rows w_i div v(x_i) = 0, derivatives per metre (Grønli 2017, eq. 3.13)."""

    @checked(points=PLACES)
    def __init__(self, knots: Knots, points: torch.Tensor, components: int, weight: torch.Tensor) -> None:
        check_real("points", points)
        super().__init__(knots, points, components, points.new_zeros(points.shape[:1]), weight)

    def rows_at(self, index: slice | torch.Tensor) -> torch.Tensor:
        """(n, local_size, C), 1/m, unweighted."""
        axes, t = self.knots.axes, self.t[index]
        columns = [self.knots.stencil(t, [int(a == k) for a in range(axes)]) for k in range(self.components)]
        return torch.stack(columns, dim=-1)


class CellRows:
    """The same rows in every listed knot cell: integrals of squared derivatives over these cells.

    ``factor`` is (rows, local_size) and applied to each component, or (rows, local_size, C) and
    coupling them; its Gram matrix is the integral over one cell (see ``penalties``).
    """

    @checked
    def __init__(self, knots: Knots, cells: torch.Tensor, factor: torch.Tensor, components: int) -> None:
        tail = () if factor.ndim == 2 else (components,)
        if factor.shape[1:] != (knots.local_size, *tail):
            raise InvalidInput(
                f"factor has the shape {tuple(factor.shape)}: it must be (rows, {knots.local_size}), or with "
                f"a last axis of the {components} components"
            )
        self.knots, self.cell, self.components = knots, cells, components
        self.factor = factor
        self.coupled = factor.ndim == 3
        self.nodes = knots.local_nodes(cells)
        rows = len(cells) * len(factor) * (1 if self.coupled else components)
        self.target = torch.zeros(rows, dtype=factor.dtype, device=factor.device)

    def matvec(self, c: torch.Tensor) -> torch.Tensor:
        """(nodes, C) -> (rows,)."""
        near, factor = c[self.nodes], self.factor.to(c.dtype)
        if self.coupled:
            return (near.flatten(1) @ factor.flatten(1).T).flatten()
        return torch.einsum("rl,nlc->nrc", factor, near).flatten()

    def rmatvec(self, r: torch.Tensor) -> torch.Tensor:
        """(rows,) -> (nodes, C), the exact adjoint."""
        count, factor = len(self.cell), self.factor.to(r.dtype)
        if self.coupled:
            values = (r.view(count, -1) @ factor.flatten(1)).view(-1, self.components)
        else:
            values = torch.einsum("rl,nrc->nlc", factor, r.view(count, len(factor), -1)).flatten(0, 1)
        out = torch.zeros(self.knots.nodes, self.components, dtype=r.dtype, device=r.device)
        return out.index_add_(0, self.nodes.flatten(), values)

    def repeated(self, count: int) -> "CellRows":
        """The same uncoupled rows for ``count`` components."""
        return CellRows(self.knots, self.cell, self.factor, count)


class System:
    """Stacked row blocks with damping: minimise |A c - b|^2 + damping^2 |c|^2 (Grønli 2017, eq. 3.22)."""

    @checked
    def __init__(self, knots: Knots, components: int, blocks: Sequence[RowBlock], damping: float) -> None:
        if not blocks:
            raise InvalidInput("the system has no rows: give samples, walls or penalties")
        if components < 1 or not 0 <= damping < math.inf:
            raise InvalidInput(
                f"a system needs a component and a finite damping from 0 on, got {components}, {damping}"
            )
        if not any(len(block.cell) for block in blocks):
            raise InvalidInput("the system has blocks without any row: give samples, walls or penalties")
        for block in blocks:
            _check_block(block, knots, components, blocks[0].cell.device)
        self.knots, self.components = knots, components
        self.blocks, self.damping = list(blocks), float(damping)
        self._sizes = [len(block.target) for block in self.blocks]

    @property
    def unknowns(self) -> int:
        """Coefficients of all components."""
        return self.knots.nodes * self.components

    def target(self) -> torch.Tensor:
        """(rows,), weighted right-hand sides of all blocks."""
        return torch.cat([block.target for block in self.blocks])

    def matvec(self, x: torch.Tensor) -> torch.Tensor:
        """(unknowns,) -> (rows,)."""
        c = x.view(self.knots.nodes, self.components)
        return torch.cat([block.matvec(c) for block in self.blocks])

    def rmatvec(self, r: torch.Tensor) -> torch.Tensor:
        """(rows,) -> (unknowns,), the exact adjoint of :meth:`matvec`."""
        parts = r.split(self._sizes)
        pulled = [block.rmatvec(part) for block, part in zip(self.blocks, parts, strict=True)]
        return reduce(torch.add, pulled).flatten()

    def right_side(self) -> torch.Tensor:
        """A' b, float64."""
        return self.rmatvec(self.target().double())

    def gradient(self, x: torch.Tensor) -> torch.Tensor:
        """A'(b - A x) - damping^2 x recomputed in float64, half the negative gradient of the cost."""
        x = x.double()
        return self.rmatvec(self.target().double() - self.matvec(x)) - self.damping**2 * x

    def touched(self) -> torch.Tensor:
        """(nodes,) bool: coefficients in some row's support. The others stay exactly zero."""
        used = torch.zeros(self.knots.nodes, dtype=torch.bool, device=self.blocks[0].target.device)
        used[self.knots.local_nodes(self.knots.cell_index(self.cells())).flatten()] = True
        return used

    def cells(self) -> torch.Tensor:
        """Sorted flat numbers of the cells that hold rows."""
        return torch.unique(torch.cat([self.knots.cell_number(block.cell) for block in self.blocks]))


def _check_block(block: RowBlock, knots: Knots, components: int, device: torch.device) -> None:
    """Refuse rows that do not belong to a system, or lie in cells that its knots do not have.

    Args:
        block: the rows.
        knots: of the system.
        components: of the system.
        device: of its other rows.

    Raises:
        InvalidInput: they differ in knots, components or device, their cells are out of range, or a target is not
            finite.
    """
    name = type(block).__name__
    if block.knots != knots:
        raise InvalidInput(f"{name} were made for other knots than the system's: {block.knots}, not {knots}")
    if block.components != components:
        raise InvalidInput(f"{name} are of {block.components} components, the system of {components}")
    if block.cell.device != device or block.target.device != device or device.type == "meta":
        devices = f"'{block.cell.device}' and '{block.target.device}'"
        raise InvalidInput(f"{name} are on {devices}: all rows must hold their numbers on one device, here '{device}'")
    if not bool(torch.isfinite(block.target).all()):
        raise InvalidInput(f"{name} have a target or weight that is not finite: leave such samples out")
    if block.cell.numel():
        least, most = torch.aminmax(block.cell, dim=0)
        if bool((least < 0).any()) or any(int(last) >= n for last, n in zip(most, knots.cells, strict=True)):
            raise InvalidInput(
                f"{name} lie in cells {least.tolist()} to {most.tolist()}, but those of the knots run from 0 to "
                f"{[n - 1 for n in knots.cells]}"
            )
