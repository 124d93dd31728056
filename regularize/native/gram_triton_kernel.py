"""The Triton kernel of the assembly; importing this needs triton (see gram_triton.py)."""

# mypy: allow-untyped-defs, allow-incomplete-defs
# (the language of Triton has no types)
import triton
import triton.language as tl


@triton.jit
def add_grams(values, start, unknown, band, width, size, columns: tl.constexpr, tile: tl.constexpr):
    """Add each cell's sum of row products to the lower band.

    ``values`` (rows, size) sorted by cell, ``start`` (cells + 1), ``unknown`` (cells, size) solve numbers
    that rise along a row. Grid: (cells, pairs of column tiles with the row's tile not before the column's).
    """
    cell, pair = tl.program_id(0), tl.program_id(1)
    i_tile = pair // columns
    j_tile = pair % columns
    if j_tile <= i_tile:
        i = i_tile * tile + tl.arange(0, tile)
        j = j_tile * tile + tl.arange(0, tile)
        total = tl.zeros((tile, tile), dtype=tl.float64)
        for row in range(tl.load(start + cell), tl.load(start + cell + 1)):
            # rank-one updates: float64 dot products of blocks are not on every GPU
            left = tl.load(values + row * size + i, mask=i < size, other=0.0)
            right = tl.load(values + row * size + j, mask=j < size, other=0.0)
            total += left[:, None] * right[None, :]
        into = tl.load(unknown + cell * size + i, mask=i < size, other=0)[:, None]
        out_of = tl.load(unknown + cell * size + j, mask=j < size, other=0)[None, :]
        inside = (i < size)[:, None] & (j < size)[None, :] & (into >= out_of)
        # neighbouring cells share coefficients: their programs meet in the same entries
        tl.atomic_add(band + out_of * width + (into - out_of), total, mask=inside)
