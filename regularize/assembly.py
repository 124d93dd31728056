"""The normal matrix A'A + damping^2 I in band storage, summed cell by cell from small dense Gram matrices.

Every row lives in one knot cell and touches only that cell's coefficients, so a cell with many rows adds one
dense block instead of one sparse product per row. Only coefficients that some row touches are kept, numbered
with the longest axis slowest, which makes the band as narrow as a lexicographic order can.
"""

from dataclasses import dataclass

import numpy as np
import torch

from .operators import CellRows, System, VectorRows, _CoupledRows

CELLS_PER_PASS = 64  # bounds the dense blocks (cells, L C, L C) of a pass to about 20 MB for cubic 3-D


@dataclass(frozen=True)
class Ordering:
    """Numbering of the touched coefficients that keeps the band narrow."""

    nodes: torch.Tensor  # (active,) flat coefficient numbers in solve order
    position: torch.Tensor  # (nodes,) place in that order, -1 for untouched coefficients
    local: torch.Tensor  # (L,) permutation that sorts a cell's local coefficients by position
    cells: torch.Tensor  # (cells,) flat numbers of the cells that hold rows
    half_bandwidth: int  # in unknowns, components included


def order(system: System) -> Ordering:
    """Number the touched coefficients of ``system``."""
    knots = system.knots
    cells = system.cells()
    used = torch.zeros(knots.nodes, dtype=torch.bool, device=cells.device)
    local_nodes = knots.local_nodes(knots.cell_index(cells))
    used[local_nodes.flatten()] = True
    # array axes (slowest first), longest first; the sort is stable, so a cube keeps its order
    slowest_first = sorted(range(knots.axes), key=lambda k: -knots.shape[k])
    flat = torch.arange(knots.nodes, device=cells.device).view(knots.shape).permute(slowest_first).flatten()
    nodes = flat[used[flat]]
    position = torch.full((knots.nodes,), -1, dtype=torch.int64, device=cells.device)
    position[nodes] = torch.arange(len(nodes), device=cells.device)
    size = (knots.degree + 1,) * knots.axes
    local = torch.arange(knots.local_size, device=cells.device).view(size).permute(slowest_first).flatten()
    spread = position[local_nodes[:, local[-1]]] - position[local_nodes[:, local[0]]]
    half = (int(spread.max()) + 1) * system.components - 1
    return Ordering(nodes, position, local, cells, half)


def normal_band(system: System, ordering: Ordering) -> np.ndarray:
    """(unknowns, half_bandwidth + 1) float64: row j holds entries (j, j), (j + 1, j), ... of A'A.

    Its transpose is LAPACK's lower band storage without a copy.
    """
    count, width = len(ordering.nodes) * system.components, ordering.half_bandwidth + 1
    band = torch.zeros(count, width, dtype=torch.float64)
    band[:, 0] = system.damping**2
    groups = [_CellGroups(block, system, ordering) for block in system.blocks]
    for start in range(0, len(ordering.cells), CELLS_PER_PASS):
        part = slice(start, min(start + CELLS_PER_PASS, len(ordering.cells)))
        total = sum(group.gram(part) for group in groups)
        _scatter(band, total, system, ordering, part)
    return band.numpy()


def _scatter(band: torch.Tensor, gram: torch.Tensor, system: System, ordering: Ordering, part: slice) -> None:
    """Add blocks (cells, L C, L C) to the lower band."""
    knots, c = system.knots, system.components
    nodes = knots.local_nodes(knots.cell_index(ordering.cells[part]))[:, ordering.local]
    unknown = (ordering.position[nodes][:, :, None] * c + torch.arange(c)).flatten(1)
    permuted = (ordering.local[:, None] * c + torch.arange(c)).flatten()
    row, column = torch.tril_indices(len(permuted), len(permuted)).unbind()
    i, j = unknown[:, row], unknown[:, column]
    values = gram[:, permuted[row], permuted[column]]
    band.view(-1).index_add_(0, (j * band.shape[1] + i - j).flatten(), values.flatten())


class _CellGroups:
    """Rows of one block sorted by cell, and their Gram matrices for a range of cells."""

    def __init__(self, block: object, system: System, ordering: Ordering) -> None:
        self.block, self.components, self.size = block, system.components, system.knots.local_size
        number = system.knots.cell_number(block.cell)
        self.sorted = torch.argsort(number, stable=True)
        slot = torch.searchsorted(ordering.cells, number[self.sorted])
        self.start = torch.searchsorted(slot, torch.arange(len(ordering.cells) + 1))

    def gram(self, part: slice) -> torch.Tensor:
        """(cells, L C, L C) sum over the rows of each cell."""
        counts = self.start[part.start + 1 : part.stop + 1] - self.start[part]
        if isinstance(self.block, CellRows):
            return self._repeated(counts)
        most = int(counts.max())
        total = torch.zeros(
            len(counts), self.size, self.components, self.size, self.components, dtype=torch.float64
        )
        if most == 0:
            return total.flatten(1, 2).flatten(2, 3)
        slots = torch.arange(most)
        valid = slots < counts[:, None]
        rows = torch.where(valid, self.start[part, None] + slots, 0)
        rows = self.sorted[rows.flatten()]
        valid = valid.flatten().double()
        if isinstance(self.block, VectorRows):
            self._add_components(total, rows, valid)
        elif isinstance(self.block, _CoupledRows):
            values = self.block.rows_at(rows) * (valid * self.block.weight[rows].double())[:, None, None]
            values = values.view(len(counts), most, -1)
            total += torch.bmm(values.mT, values).view_as(total)
        return total.flatten(1, 2).flatten(2, 3)

    def _add_components(self, total: torch.Tensor, rows: torch.Tensor, valid: torch.Tensor) -> None:
        values = self.block.rows_at(rows).view(len(total), -1, self.size)
        weight = self.block.weight[rows].double() * valid[:, None]
        for k in range(self.components):
            scaled = values * weight[:, k].view(len(total), -1, 1)
            total[:, :, k, :, k] += torch.bmm(scaled.mT, scaled)

    def _repeated(self, counts: torch.Tensor) -> torch.Tensor:
        factor = self.block.factor.double()
        if self.block.coupled:
            one = factor.flatten(1).T @ factor.flatten(1)
        else:
            one = torch.einsum("rl,rm,cd->lcmd", factor, factor, torch.eye(self.components).double())
            one = one.flatten(0, 1).flatten(1, 2)
        return counts.double()[:, None, None] * one
