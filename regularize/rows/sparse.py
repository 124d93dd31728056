"""The system as a sparse matrix with its transpose stored beside it (Grønli 2017, sec. 3.2.5).

Twice the memory of one copy, but A' u then runs as fast as A v. The matrix-free operators need neither.
"""

import warnings
from collections.abc import Callable

import numpy as np
import torch
from scipy.sparse import csr_array

from regularize.arguments import checked

from .operators import CellRows, RowBlock, System, VectorRows, at_points
from .ordering import Ordering

Apply = Callable[[torch.Tensor], torch.Tensor]


@checked
def sparse_matrix(system: System) -> torch.Tensor:
    """The rows of ``system`` as one float64 CSR matrix (rows, unknowns), weights included."""
    rows, columns, values, offset = [], [], [], 0
    for block in system.blocks:
        column, value = _entries(block, system.components)
        count, width = column.shape
        rows.append(torch.arange(offset, offset + count).repeat_interleave(width))
        columns.append(column.flatten())
        values.append(value.flatten())
        offset += count
    index = torch.stack([torch.cat(rows), torch.cat(columns)])
    shape = (offset, system.unknowns)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torch calls its CSR format a beta, once per process
        return torch.sparse_coo_tensor(index, torch.cat(values), shape).to_sparse_csr()


@checked
def sparse_operators(system: System) -> tuple[Apply, Apply]:
    """matvec and rmatvec of the stored matrix and transpose, in the precision of their argument."""
    forward = sparse_matrix(system)
    stored = {torch.float64: (forward, _transposed(forward))}

    def pair(dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
        if dtype not in stored:
            matrix, transpose = stored[torch.float64]
            stored[dtype] = matrix.to(dtype), transpose.to(dtype)
        return stored[dtype]

    return (lambda x: pair(x.dtype)[0] @ x), (lambda r: pair(r.dtype)[1] @ r)


def _transposed(matrix: torch.Tensor) -> torch.Tensor:
    return matrix.to_sparse_coo().t().coalesce().to_sparse_csr()


def _entries(block: RowBlock, c: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Columns and values (rows, entries per row) of one block."""
    nodes = block.knots.local_nodes(block.cell)
    if isinstance(block, CellRows):
        return _cell_entries(block, nodes, c)
    rows = at_points(block)
    values, weight = rows.rows_at(slice(None)).double(), rows.weight.double()
    if isinstance(rows, VectorRows):
        column = nodes[:, None, :] * c + torch.arange(c)[:, None]
        value = values[:, None, :] * weight[:, :, None]
        return column.flatten(0, 1), value.flatten(0, 1)
    column = nodes[:, :, None] * c + torch.arange(c)
    return column.flatten(1), (values * weight[:, None, None]).flatten(1)


def _cell_entries(block: CellRows, nodes: torch.Tensor, c: int) -> tuple[torch.Tensor, torch.Tensor]:
    factor, cells = block.factor.double(), len(nodes)
    rows = len(factor)
    if block.coupled:
        column = (nodes[:, None, :, None] * c + torch.arange(c)).expand(cells, rows, -1, c)
        value = factor.expand(cells, *factor.shape)
        return column.flatten(0, 1).flatten(1), value.flatten(0, 1).flatten(1)
    column = (nodes[:, None, None, :] * c + torch.arange(c)[:, None]).expand(cells, rows, c, -1)
    value = factor[:, None, :].expand(cells, rows, c, -1)
    return column.flatten(0, 2), value.flatten(0, 2)


def value_matrix(fit: VectorRows, ordering: Ordering) -> csr_array:
    """(n, active) values of the coefficients' functions, in solve order, at the samples."""
    nodes, values = fit.knots.local_nodes(fit.cell), fit.rows_at(slice(None)).double()
    place = torch.empty(fit.knots.nodes, dtype=torch.int64)
    place[ordering.nodes] = torch.arange(len(ordering.nodes))
    starts = np.arange(0, nodes.numel() + 1, nodes.shape[1])
    shape = (len(nodes), len(ordering.nodes))
    return csr_array((values.flatten().numpy(), place[nodes].flatten().numpy(), starts), shape=shape)
