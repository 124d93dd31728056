"""Small algebra on lower band storage (n, width): row j holds entries (j, j), (j + 1, j), ..."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.linalg.blas import dsbmv

from .blas_threads import one_thread

ROWS = 256  # copied at a time


def to_single(band: torch.Tensor) -> torch.Tensor:
    """The band in float32 within the memory of the given float64 one, which is lost."""
    count, width = band.shape
    single = band.view(-1).view(torch.float32)[: count * width].view(count, width)
    for start in range(0, count, ROWS):  # a row moves to the front of where it stood, or before
        single[start : start + ROWS] = band[start : start + ROWS].float()
    return single


def dense_block(band: torch.Tensor, row: int, column: int) -> torch.Tensor:
    """Block (rows row.., columns column.., at most as wide as the band each) of the lower triangle."""
    count, width = band.shape
    i = torch.arange(row, min(row + width, count), device=band.device)[:, None]
    j = torch.arange(column, min(column + width, count), device=band.device)
    offset = i - j
    inside = (offset >= 0) & (offset < width)
    return torch.where(inside, band[j.expand_as(offset), offset.clamp(0, width - 1)], 0.0)


def widen(scalar: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Band of kron(scalar matrix, diag(scale)): component c of every coefficient is scaled by scale (C,)."""
    n, width = scalar.shape
    c = len(scale)
    out = torch.zeros(n, c, width * c, dtype=scalar.dtype)
    for k in range(c):
        out[:, k, ::c] = scale[k] * scalar
    return out.view(n * c, width * c)


def add_widened(band: torch.Tensor, scalars: Sequence[torch.Tensor]) -> None:
    """Add to the band of C components (n C, width C) scalar bands (n, width), the k-th to component k."""
    n, width = scalars[0].shape
    view = band.view(n, len(scalars), width, len(scalars))
    for k, scalar in enumerate(scalars):
        view[:, k, :, 0] += scalar


def multiply(band: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Symmetric band matrix times x (n, k)."""
    a = band.numpy().T  # Fortran order, as LAPACK wants it
    with one_thread():
        columns = [dsbmv(len(a) - 1, 1.0, a, column, lower=1) for column in x.T.contiguous().numpy()]
    return torch.from_numpy(np.stack(columns, axis=1))
