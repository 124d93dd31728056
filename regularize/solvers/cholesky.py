"""Cholesky factorisation and triangular solves in lower band storage, by dense blocks inside the envelope.

LAPACK's banded routine works in strips of 32 columns over the full bandwidth, far below the speed of the processor's
matrix products. Here strips are wider, and each ends at its own last row: coefficients at the ends of a ventricle have
fewer neighbours than those in its middle, and the factor of a matrix keeps its envelope (A. George and J. Liu, Computer
Solution of Large Sparse Positive Definite Systems, 1981, chapter 4).

Row j of a band (n, width) holds the entries (j, j), (j + 1, j), ... of the matrix, so that entry (i, j) lies at
i + j (width - 1): any block inside the band is a dense matrix of column stride width - 1. Entries of such a view above
the diagonal or beyond the band belong to other places of the matrix and are masked.
"""

from collections.abc import Iterator

import torch

STRIP = 128  # columns factored at once, and columns of the remainder updated at once


def factorise(band: torch.Tensor, reach: torch.Tensor) -> bool:
    """Overwrite the band (n, width) by its Cholesky factor; False where it is not positive definite.

    ``reach`` (n,), rising: the last row in which column j may have an entry.
    """
    for start, stop, end in _strips(band, reach):
        diagonal = _block(band, slice(start, stop), slice(start, stop))
        factor, failed = torch.linalg.cholesky_ex(diagonal.tril())
        if int(failed):
            return False
        _overwrite(diagonal, factor, torch.ones_like(factor, dtype=torch.bool).tril())
        if end > stop:
            below = list(_below(band, start, stop, end))
            panel = torch.cat([block for _, block in below])
            panel = torch.linalg.solve_triangular(factor.mT, panel, upper=True, left=False)
            for rows, block in below:
                inside = torch.ones_like(block, dtype=torch.bool)
                inside = inside.triu(1) if rows.start >= start + band.shape[1] else inside
                _overwrite(_block(band, rows, slice(start, stop)), panel[rows.start - stop : rows.stop - stop], inside)
            _update(band, stop, end, panel)
    return True


def solve(band: torch.Tensor, reach: torch.Tensor, right: torch.Tensor, *, lower: bool, upper: bool) -> torch.Tensor:
    """x (n, k) with L x = right, L' x = right or, with both, L L' x = right for the factor L in the band."""
    x = _solve_lower(band, reach, right) if lower else right
    return _solve_upper(band, reach, x) if upper else x


def _solve_lower(band: torch.Tensor, reach: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    x = right.clone()
    for start, stop, end in _strips(band, reach):
        lower = _block(band, slice(start, stop), slice(start, stop)).tril()
        x[start:stop] = torch.linalg.solve_triangular(lower, x[start:stop], upper=False)
        for rows, block in _below(band, start, stop, end):
            x[rows].addmm_(block, x[start:stop], alpha=-1.0)
    return x


def _solve_upper(band: torch.Tensor, reach: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    x = right.clone()
    for start, stop, end in reversed(list(_strips(band, reach))):
        for rows, block in _below(band, start, stop, end):
            x[start:stop].addmm_(block.mT, x[rows], alpha=-1.0)
        lower = _block(band, slice(start, stop), slice(start, stop)).tril()
        x[start:stop] = torch.linalg.solve_triangular(lower.mT, x[start:stop], upper=True)
    return x


def _strips(band: torch.Tensor, reach: torch.Tensor) -> Iterator[tuple[int, int, int]]:
    """(start, stop) of strips of columns, and the end of their rows."""
    count, width = band.shape
    step = max(1, min(STRIP, width - 1))  # a wider block would alias itself
    for start in range(0, count, step):
        stop = min(start + step, count)
        yield start, stop, int(reach[stop - 1]) + 1


def _block(band: torch.Tensor, rows: slice, columns: slice) -> torch.Tensor:
    """View of a block of the matrix."""
    stride = band.shape[1] - 1
    size = (rows.stop - rows.start, columns.stop - columns.start)
    return band.as_strided(size, (1, stride), band.storage_offset() + rows.start + columns.start * stride)


def _below(band: torch.Tensor, start: int, stop: int, end: int) -> Iterator[tuple[slice, torch.Tensor]]:
    """Rows and blocks of a strip below its diagonal: the rectangle, and the corner that leaves the band."""
    edge = min(end, start + band.shape[1])
    columns = slice(start, stop)
    if edge > stop:
        yield slice(stop, edge), _block(band, slice(stop, edge), columns)
    if end > edge:
        yield slice(edge, end), _block(band, slice(edge, end), columns).triu(1)


def _overwrite(block: torch.Tensor, values: torch.Tensor, where: torch.Tensor) -> None:
    block.copy_(torch.where(where, values, block))


def _update(band: torch.Tensor, stop: int, end: int, panel: torch.Tensor) -> None:
    """Subtract panel panel' from the rows and columns (stop, end) of the lower triangle."""
    step = max(1, min(STRIP, band.shape[1] - 1))
    for first in range(stop, end, step):
        last = min(first + step, end)
        left = panel[first - stop : last - stop]
        # zeros above the diagonal leave the places that the view has there as they are
        _block(band, slice(first, last), slice(first, last)).sub_((left @ left.mT).tril())
        if end > last:
            block = _block(band, slice(last, end), slice(first, last))
            block.addmm_(panel[last - stop :], left.mT, alpha=-1.0)
