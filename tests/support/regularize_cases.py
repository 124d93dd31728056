"""Small systems that several tests of the spline solver share."""

import torch

from regularize import CellRows, DirectionRows, DivergenceRows, Knots, VectorRows
from regularize.rows.penalties import curvature_gram, divergence_gram, row_factor


def make(axes, degree=3, components=None, n=40):
    generator = torch.Generator().manual_seed(axes)
    components = axes if components is None else components
    upper = torch.tensor((4.0, 3.0, 2.0)[:axes], dtype=torch.float64)
    knots = Knots.covering((0.0,) * axes, upper.tolist(), (1.0, 0.8, 0.9)[:axes], degree)
    points = torch.rand(n, axes, generator=generator, dtype=torch.float64) * upper
    draw = torch.rand(n, components, generator=generator, dtype=torch.float64)
    weight = torch.rand(n, generator=generator, dtype=torch.float64)
    return knots, points, draw, weight, components


def blocks_of(axes, degree=3):
    knots, points, draw, weight, components = make(axes, degree)
    cells = knots.cell_index(torch.unique(knots.cell_number(knots.locate(points)[0])))
    blocks = {
        "vector": VectorRows(knots, points, draw, weight[:, None] * (1 + draw)),
        "direction": DirectionRows(knots, points, draw, weight, weight),
        "divergence": DivergenceRows(knots, points, components, weight),
        "cell divergence": CellRows(
            knots, cells, row_factor(divergence_gram(knots, components), components), components
        ),
    }
    if degree > 1:
        blocks["curvature"] = CellRows(knots, cells, row_factor(curvature_gram(knots, range(axes))), components)
    return knots, blocks
