"""Row blocks have the entries that their formulas say."""

import itertools

import numpy as np
import pytest
import torch
from regularize_cases import make

from regularize import CellRows, DivergenceRows
from regularize.rows.penalties import curvature_gram, divergence_gram, row_factor


@pytest.mark.parametrize("axes", [2, 3])
def test_divergence_rows_of_a_quadratic_field(axes):
    knots, points, _, weight, _ = make(axes)
    # v_k = x_k^2 / 2 has divergence sum_k x_k; quadratics are in the cubic space: fit them exactly first
    sample = torch.rand(3000, axes, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    sample = sample * torch.tensor((4.0, 3.0, 2.0)[:axes])
    dense = torch.zeros(3000, knots.nodes, dtype=torch.float64)
    cell, t = knots.locate(sample)
    dense.scatter_(1, knots.local_nodes(cell), knots.stencil(t))
    c = torch.linalg.lstsq(dense, sample**2 / 2, driver="gelsd").solution
    rows = DivergenceRows(knots, points, axes, weight).matvec(c)
    assert torch.allclose(rows, weight * points.sum(1), atol=1e-7)


@pytest.mark.parametrize("axes", [2, 3])
def test_cell_integrals_equal_fine_quadrature(axes):
    knots, _, _, _, _ = make(axes)
    cells = torch.ones(1, axes, dtype=torch.int64)
    q, w = map(torch.as_tensor, np.polynomial.legendre.leggauss(6))
    t = torch.stack(torch.meshgrid(*[(q + 1) / 2] * axes, indexing="ij"), -1).reshape(-1, axes)
    weight = torch.ones(len(t), dtype=torch.float64)
    for axis in range(axes):
        weight = weight * (w / 2)[torch.meshgrid(*[torch.arange(6)] * axes, indexing="ij")[axis].flatten()]
    origin, spacing = (torch.tensor(x, dtype=torch.float64) for x in (knots.origin, knots.spacing))
    points = origin + spacing * (1 + t)
    volume = spacing.prod()
    c = torch.randn(knots.nodes, axes, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rows = DivergenceRows(knots, points, axes, (weight * volume).sqrt())
    exact = CellRows(knots, cells, row_factor(divergence_gram(knots, axes), axes), axes)
    assert torch.isclose(rows.matvec(c).square().sum(), exact.matvec(c).square().sum(), rtol=1e-10)
    near = c[knots.local_nodes(cells.expand(len(t), -1))]
    for order in (1, 2, 3):
        total = 0.0
        for along in itertools.product(range(axes), repeat=order):
            values = torch.einsum("nl,nlc->nc", knots.stencil(t, [along.count(a) for a in range(axes)]), near)
            total = total + (weight[:, None] * volume * values**2).sum()
        curved = CellRows(knots, cells, row_factor(curvature_gram(knots, range(axes), order)), axes)
        assert torch.isclose(curved.matvec(c).square().sum(), total, rtol=1e-10)
