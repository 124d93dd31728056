"""The normal matrix's band by a Triton kernel, for systems on a GPU.

Row values come from torch, a bounded number of cells at a time; the kernel sums each cell's products in
registers and adds them to the band by atomics, so that two runs differ by rounding. Under TRITON_INTERPRET=1
(set before triton is imported) the same kernel runs on CPU tensors, slowly, for tests.
"""

import importlib.util
import os

import torch

from regularize.rows.assembly import add_cell_rows, empty_band
from regularize.rows.operators import CellRows, PointRows, System, VectorRows, at_points
from regularize.rows.ordering import Ordering

TILE = 32  # columns of a program: 1024 sums, eight for each of 128 threads
CELLS_PER_PASS = 512  # bounds the stored row values to about 160 MB at 100 rows a cell


def available(device: torch.device) -> bool:
    """Whether triton is installed and can run on ``device``: a GPU, or any under its interpreter."""
    if importlib.util.find_spec("triton") is None:
        return False
    return device.type == "cuda" or os.environ.get("TRITON_INTERPRET") == "1"


def triton_band(system: System, ordering: Ordering) -> torch.Tensor:
    """As :func:`regularize.rows.assembly.reference_band`; ImportError where triton is not installed."""
    band = empty_band(system, ordering)
    for block in system.blocks:
        if isinstance(block, CellRows):
            add_cell_rows(band, block, system.components, ordering)
        elif len(block.cell) > 0:
            _add_block(band, at_points(block), system.components, ordering)
    return band


def _add_block(band: torch.Tensor, block: PointRows, components: int, ordering: Ordering) -> None:
    slot = ordering.slots(block.cell)
    index = torch.argsort(slot, stable=True)
    edges = torch.arange(len(ordering.keys) + 1, device=slot.device)
    start = torch.searchsorted(slot[index], edges)
    for first in range(0, len(ordering.keys), CELLS_PER_PASS):
        last = min(first + CELLS_PER_PASS, len(ordering.keys))
        rows = index[start[first] : start[last]]
        if len(rows) == 0:
            continue
        near, begin = ordering.position[first:last], start[first : last + 1] - start[first]
        weight = block.weight[rows].double()
        values = block.rows_at(rows).double()
        if not isinstance(block, VectorRows):
            component = torch.arange(components, device=near.device)
            unknown = (near[:, :, None] * components + component).flatten(1)
            values = values.view(len(rows), -1, components)[:, ordering.local()].flatten(1)
            _launch(band, weight[:, None] * values, begin, unknown)
            continue
        values = values.view(len(rows), -1)[:, ordering.local()]
        for k in range(components):  # components share no row: one block each
            _launch(band, weight[:, k, None] * values, begin, near * components + k)


def _launch(band: torch.Tensor, values: torch.Tensor, start: torch.Tensor, unknown: torch.Tensor) -> None:
    from .gram_triton_kernel import add_grams

    tiles = -(-values.shape[1] // TILE)
    grid = (len(unknown), tiles * tiles)
    parts = (values.contiguous(), start.contiguous(), unknown.contiguous(), band)
    add_grams[grid](*parts, band.shape[1], values.shape[1], columns=tiles, tile=TILE)
