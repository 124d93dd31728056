"""Numbering of the coefficients that rows touch, longest axis slowest: a banded normal matrix."""

from dataclasses import dataclass
from math import prod

import torch

from regularize.basis.knots import Knots

from .operators import System


@dataclass(frozen=True)
class Ordering:
    """Solve order of the touched coefficients of one set of knot cells."""

    knots: Knots
    axes: tuple[int, ...]  # point axes (x = 0), slowest in solve order first
    keys: torch.Tensor  # (cells,) sorted solve-order numbers of the cells that hold rows
    places: torch.Tensor  # (all cells of the grid,) place of each solve-order number in ``keys``
    nodes: torch.Tensor  # (active,) flat coefficient numbers in solve order
    position: torch.Tensor  # (cells, L) solve positions of each cell's coefficients, rising along L
    half_bandwidth: int  # in coefficients: largest position difference within a cell

    def key(self, cell: torch.Tensor) -> torch.Tensor:
        """Solve-order number (n,) of cells (n, A)."""
        number = torch.zeros(cell.shape[:-1], dtype=torch.int64, device=cell.device)
        for axis in self.axes:
            number = number * self.knots.cells[axis] + cell[..., axis]
        return number

    def slots(self, cell: torch.Tensor) -> torch.Tensor:
        """Place (n,) of cells (n, A) in ``keys``; they must be among them."""
        return self.places[self.key(cell)]

    def expand(self, x: torch.Tensor) -> torch.Tensor:
        """(active, ...) in solve order -> (nodes, ...) with zeros at untouched coefficients."""
        full = torch.zeros(self.knots.nodes, *x.shape[1:], dtype=x.dtype, device=x.device)
        full[self.nodes] = x
        return full

    def local(self) -> torch.Tensor:
        """(L,) array-order place of each solve-order local coefficient."""
        array_axes = [self.knots.axes - 1 - axis for axis in self.axes]
        size = (self.knots.degree + 1,) * self.knots.axes
        local = torch.arange(self.knots.local_size, device=self.keys.device)
        return local.view(size).permute(array_axes).flatten()

    def reach(self, components: int) -> torch.Tensor:
        """(active * C,) last unknown that shares a row with an unknown or with one before it: the envelope."""
        first, last = self.position[:, 0], self.position[:, -1]
        reach = torch.zeros_like(self.nodes).scatter_reduce(0, first, last, "amax").cummax(0).values
        return (components * (reach + 1) - 1).repeat_interleave(components)

    def slabs(self) -> torch.Tensor:
        """(slabs + 1,) starts in ``keys`` of runs of degree + 1 cell layers along the slowest axis.

        Cells of slabs two apart touch no common coefficient.
        """
        layer = self.keys
        for axis in self.axes[1:]:
            layer = layer // self.knots.cells[axis]
        slab = layer // (self.knots.degree + 1)
        edges = torch.arange(int(slab[-1]) + 2, device=slab.device)
        return torch.searchsorted(slab, edges)


def order(system: System) -> Ordering:
    """Number the coefficients that ``system`` touches; the longest axis runs slowest (narrowest band)."""
    knots = system.knots
    # the sort is stable, so that a cube keeps the array order: last axis slowest, x fastest
    axes = tuple(sorted(reversed(range(knots.axes)), key=lambda k: -knots.cells[k]))
    cell = torch.cat([block.cell for block in system.blocks])
    empty = torch.empty(0)
    blank = Ordering(knots, axes, empty, empty, empty, empty, 0)
    held = torch.zeros(prod(knots.cells), dtype=torch.bool, device=cell.device)
    held[blank.key(cell)] = True  # a table instead of sorting the rows
    keys, places = held.nonzero().flatten(), held.cumsum(0) - 1
    number, columns = keys, {}
    for axis in reversed(axes):
        columns[axis] = number % knots.cells[axis]
        number = number // knots.cells[axis]
    cell = torch.stack([columns[axis] for axis in range(knots.axes)], dim=-1)
    array_axes = [knots.axes - 1 - axis for axis in axes]
    touched = knots.local_nodes(cell)[:, blank.local().to(keys.device)]
    used = torch.zeros(knots.nodes, dtype=torch.bool, device=keys.device)
    used[touched.flatten()] = True
    flat = torch.arange(knots.nodes, device=keys.device).view(knots.shape).permute(array_axes).flatten()
    nodes = flat[used[flat]]
    place = torch.empty(knots.nodes, dtype=torch.int64, device=keys.device)
    place[nodes] = torch.arange(len(nodes), device=keys.device)
    position = place[touched]
    half = int((position[:, -1] - position[:, 0]).max())
    return Ordering(knots, axes, keys, places, nodes, position, half)
