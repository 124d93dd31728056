"""Neighbour search in plain torch: cells of the search radius, sorted keys, each pair found once."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor


def half_pairs(position: Tensor, member: Tensor, radius: float, period: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """All pairs of one member closer than ``radius``; every pair once, sorted by its first particle.

    Cells are addressed by sorted keys, not by a dense table, so that a stray particle far away costs nothing
    and no cell can overflow.

    Args:
        position: (N, D), finite. member: (N,) int64. radius: same unit as the positions.
        period: (D,) period of each axis, inf where it is not periodic; at least three radii.

    Returns:
        first, second: (P,) int64 particle indices.
    """
    count, dimension = position.shape
    if count == 0:
        empty = torch.zeros(0, dtype=torch.int64, device=position.device)
        return empty, empty
    cell, cells = _cells(position, radius, period)
    key = _key(cell, member, cells)
    order = torch.argsort(key, stable=True)
    sorted_key, sorted_cell, sorted_member = key[order], cell[order], member[order]
    rank = torch.arange(count, device=position.device)
    firsts, seconds = [], []
    for offset in _half_offsets(dimension):
        if any(offset):
            target, real = _shifted(sorted_cell, offset, cells, period)
            wanted = _key(target, sorted_member, cells)
            start = torch.searchsorted(sorted_key, wanted)
            stop = torch.searchsorted(sorted_key, wanted, right=True)
            stop = torch.where(real, stop, start)
        else:
            start, stop = rank + 1, torch.searchsorted(sorted_key, sorted_key, right=True)
        first, second = _expand(start, stop)
        first, second = order[first], order[second]
        close = _square_distance(position, first, second, period) < radius * radius
        firsts.append(first[close])
        seconds.append(second[close])
    first, second = torch.cat(firsts), torch.cat(seconds)
    by_first = torch.argsort(first, stable=True)
    return first[by_first], second[by_first]


def _cells(position: Tensor, radius: float, period: Tensor | None) -> tuple[Tensor, Tensor]:
    """Cell index (N, D) and number of cells (D,) of every axis; see ``placed_cells``."""
    return placed_cells(position, radius, period)[:2]


def placed_cells(position: Tensor, edge: float, period: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cell index (N, D), number of cells (D,), lower corner of cell 0 (D,), edges (D,); periodic axes hold whole cells.

    Cells begin at whole multiples of their edge wherever the particles are, so that which particles share one, and
    in what order they are summed, does not depend on the other members of a batch.
    """
    width = torch.full_like(position[0], edge)
    if period is not None:
        periodic = torch.isfinite(period)
        length = torch.where(periodic, period, torch.ones_like(period)).to(position.dtype)
        width = torch.where(periodic, length / torch.floor(length / edge).clamp_min(1), width)
        position = torch.where(periodic, torch.remainder(position, length), position)
    cell = torch.floor(position / width).to(torch.int64)
    lowest = cell.amin(0)
    if period is not None:
        lowest = torch.where(periodic, torch.zeros_like(lowest), lowest)
    cell = cell - lowest
    cells = cell.amax(0) + 1
    if period is not None:
        whole = torch.round(length / width).to(torch.int64)
        cells = torch.where(periodic, whole, cells)
        cell = torch.minimum(cell, cells - 1)  # x just below the period rounds up to it
    return cell, cells, lowest.to(position.dtype) * width, width


def _key(cell: Tensor, member: Tensor, cells: Tensor) -> Tensor:
    key = member
    for axis in range(cell.shape[1] - 1, -1, -1):
        key = key * cells[axis] + cell[:, axis]
    return key


def _half_offsets(dimension: int) -> list[tuple[int, ...]]:
    """The zero offset and one of each pair of opposite neighbour offsets."""
    return [o for o in itertools.product((-1, 0, 1), repeat=dimension) if o >= (0,) * dimension]


def _shifted(cell: Tensor, offset: tuple[int, ...], cells: Tensor, period: Tensor | None) -> tuple[Tensor, Tensor]:
    """Neighbouring cell, wrapped on periodic axes, and whether it exists."""
    target = cell.clone()
    for axis, steps in enumerate(offset):
        if steps:
            target[:, axis] += steps
    if period is not None:
        target = torch.where(torch.isfinite(period), torch.remainder(target, cells), target)
    real = ((target >= 0) & (target < cells)).all(1)
    return target, real


def _expand(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """For every row r the pairs (r, start[r]), ..., (r, stop[r] - 1)."""
    length = stop - start
    row = torch.repeat_interleave(torch.arange(start.shape[0], device=start.device), length)
    begin = torch.cumsum(length, 0) - length
    within = torch.arange(row.shape[0], device=start.device) - begin[row]
    return row, start[row] + within


def nearest_image(gap: Tensor, period: Tensor | None) -> Tensor:
    """Separations (P, D) between the nearest images of two particles; ``period`` (D,): inf: not periodic."""
    if period is None:
        return gap
    finite = torch.isfinite(period)
    length = torch.where(finite, period, torch.ones_like(period)).to(gap.dtype)
    return torch.where(finite, gap - length * torch.round(gap / length), gap)


def _square_distance(position: Tensor, first: Tensor, second: Tensor, period: Tensor | None) -> Tensor:
    gap = nearest_image(position.index_select(0, first) - position.index_select(0, second), period)
    return (gap * gap).sum(1)


def cross_pairs(
    query: Tensor,
    query_member: Tensor,
    position: Tensor,
    member: Tensor,
    radius: float,
    period: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """All (query, particle) index pairs of one member closer than ``radius``, sorted by query; (P,) each."""
    empty = torch.zeros(0, dtype=torch.int64, device=position.device)
    if query.shape[0] == 0 or position.shape[0] == 0:
        return empty, empty
    both, members = torch.cat([position, query]).detach(), torch.cat([member, query_member])
    cell, cells = _cells(both, radius, period)
    count = position.shape[0]
    key = _key(cell[:count], members[:count], cells)
    order = torch.argsort(key)
    sorted_key = key[order]
    rows, found = [], []
    for offset in itertools.product((-1, 0, 1), repeat=position.shape[1]):
        target, real = _shifted(cell[count:], offset, cells, period)
        wanted = _key(target, members[count:], cells)
        start = torch.searchsorted(sorted_key, wanted)
        stop = torch.where(real, torch.searchsorted(sorted_key, wanted, right=True), start)
        row, at = _expand(start, stop)
        at = order[at]
        gap = nearest_image(query.index_select(0, row) - position.index_select(0, at), period)
        close = (gap * gap).sum(1) < radius * radius
        rows.append(row[close])
        found.append(at[close])
    row, at = torch.cat(rows), torch.cat(found)
    by_row = torch.argsort(row, stable=True)
    return row[by_row], at[by_row]
