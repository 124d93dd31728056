"""The normal matrix A'A + damping^2 I in band storage, in plain torch: the reference for the compiled one.

Every row lives in one knot cell and touches only that cell's coefficients, so a cell with many rows adds one
dense block instead of one sparse product per row.
"""

from functools import reduce
from math import prod
from mmap import mmap

import torch

from .operators import CellRows, RowBlock, System, VectorRows, at_points
from .ordering import Ordering

LAZY = 1 << 24  # bytes from which on a band is mapped page by page
CELLS_PER_PASS = 64  # bounds the dense blocks (cells, L C, L C) of a pass to about 20 MB for cubic 3-D


def empty_band(system: System, ordering: Ordering) -> torch.Tensor:
    """(unknowns, width) float64 of zeros with the damping on the diagonal.

    Row j holds entries (j, j), (j + 1, j), ... of the matrix in solve order (components fastest); its
    transpose is LAPACK's lower band storage without a copy.
    """
    c = system.components
    shape = (len(ordering.nodes) * c, (ordering.half_bandwidth + 1) * c)
    device = ordering.nodes.device
    if device.type == "cpu" and prod(shape) * 8 > LAZY:
        # pages of zeros that nothing ever touches, beyond the envelope, then take no memory
        band = torch.frombuffer(mmap(-1, prod(shape) * 8), dtype=torch.float64).view(shape)
    else:
        band = torch.zeros(shape, dtype=torch.float64, device=device)
    band[:, 0] = system.damping**2
    return band


def reference_band(system: System, ordering: Ordering) -> torch.Tensor:
    """The normal matrix of ``system`` as in :func:`empty_band`."""
    band = empty_band(system, ordering)
    groups = [_CellGroups(block, system.components, ordering) for block in system.blocks]
    for start in range(0, len(ordering.keys), CELLS_PER_PASS):
        part = slice(start, min(start + CELLS_PER_PASS, len(ordering.keys)))
        total = reduce(torch.add, [group.gram(part) for group in groups])
        _scatter(band, total, system.components, ordering, part)
    return band


def add_cell_rows(band: torch.Tensor, block: CellRows, components: int, ordering: Ordering) -> None:
    """Add the rows of one cell block, whose cells all have the same Gram matrix."""
    group = _CellGroups(block, components, ordering)
    for start in range(0, len(ordering.keys), CELLS_PER_PASS):
        part = slice(start, min(start + CELLS_PER_PASS, len(ordering.keys)))
        _scatter(band, group.gram(part), components, ordering, part)


def cell_gram(block: CellRows) -> torch.Tensor:
    """(L, C, L, C) normal matrix of one cell of a :class:`CellRows` block, float64, array order."""
    factor = block.factor.double()
    if block.coupled:
        return torch.einsum("rlc,rmd->lcmd", factor, factor)
    return torch.einsum("rl,rm,cd->lcmd", factor, factor, torch.eye(block.components).to(factor))


def _scatter(band: torch.Tensor, gram: torch.Tensor, c: int, ordering: Ordering, part: slice) -> None:
    """Add blocks (cells, L C, L C), local coefficients in array order, to the lower band."""
    component = torch.arange(c, device=band.device)
    unknown = (ordering.position[part][:, :, None] * c + component).flatten(1)
    permuted = (ordering.local()[:, None] * c + component).flatten()
    row, column = torch.tril_indices(len(permuted), len(permuted), device=band.device).unbind()
    i, j = unknown[:, row], unknown[:, column]
    values = gram[:, permuted[row], permuted[column]]
    band.view(-1).index_add_(0, (j * band.shape[1] + i - j).flatten(), values.flatten())


class _CellGroups:
    """Rows of one block sorted by cell, and their Gram matrices for a range of cells."""

    def __init__(self, block: RowBlock, components: int, ordering: Ordering) -> None:
        self.block, self.components, self.size = block, components, ordering.knots.local_size
        slot = ordering.slots(block.cell)
        self.sorted = torch.argsort(slot, stable=True)
        edges = torch.arange(len(ordering.keys) + 1, device=slot.device)
        self.start = torch.searchsorted(slot[self.sorted], edges)

    def gram(self, part: slice) -> torch.Tensor:
        """(cells, L C, L C) sum over the rows of each cell."""
        counts = self.start[part.start + 1 : part.stop + 1] - self.start[part]
        if isinstance(self.block, CellRows):
            one = cell_gram(self.block).flatten(0, 1).flatten(1, 2)
            return counts.double()[:, None, None] * one
        shape = (len(counts), *(self.size, self.components) * 2)
        total = torch.zeros(shape, dtype=torch.float64, device=counts.device)
        slots = torch.arange(int(counts.max()), device=counts.device)
        if len(slots) > 0:
            valid = slots < counts[:, None]
            rows = self.sorted[torch.where(valid, self.start[part, None] + slots, 0).flatten()]
            self._add_points(total, rows, valid.flatten().double())
        return total.flatten(1, 2).flatten(2, 3)

    def _add_points(self, total: torch.Tensor, rows: torch.Tensor, valid: torch.Tensor) -> None:
        block = at_points(self.block)
        values, weight = block.rows_at(rows).double(), block.weight[rows].double()
        if not isinstance(self.block, VectorRows):
            values = (values * (valid * weight)[:, None, None]).view(len(total), -1, self.size * self.components)
            total += torch.bmm(values.mT, values).view_as(total)
            return
        values = values.view(len(total), -1, self.size)
        for k in range(self.components):
            scaled = values * (weight[:, k] * valid).view(len(total), -1, 1)
            total[:, :, k, :, k] += torch.bmm(scaled.mT, scaled)
