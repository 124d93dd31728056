"""Small systems that several tests of the splines share; the batteries run over what `blocks_of` lists."""

import torch

from regularize import CellRows, DirectionRows, DivergenceRows, Knots, Smoother, System, VectorRows
from regularize.rows.penalties import curvature_gram, divergence_gram, row_factor

AXES = (2, 3)
# Lengths (m) and a time (s) for flows of a centimetre: tests whose subject is another one state them.
LENGTHS = {"knots": 3e-3, "divergence": 30e-3, "curvature": 1e-3, "time_curvature": 10e-3}


def smoother(**options):
    """A smoother of these lengths, with ``options``."""
    return Smoother(**LENGTHS | options)


def dense_of(operator):
    """(rows, unknowns): what an operator or a block of rows makes of the unit vectors, column after column."""
    size = operator.knots.nodes * operator.components
    shape = (size,) if isinstance(operator, System) else (operator.knots.nodes, operator.components)
    eye = torch.eye(size, dtype=torch.float64)
    return torch.stack([operator.matvec(column.view(shape)) for column in eye], dim=1)


def system_of(axes, degree=3, damping=0.1, beyond=0.0):
    """Every kind of row block in one system, on a box that reaches ``beyond`` the points."""
    knots, blocks = blocks_of(axes, degree, beyond)
    return System(knots, axes, list(blocks.values()), damping)


def make(axes, degree=3, components=None, n=40, beyond=0.0):
    generator = torch.Generator().manual_seed(axes)
    components = axes if components is None else components
    upper = torch.tensor((4.0, 3.0, 2.0)[:axes], dtype=torch.float64)
    knots = Knots.covering((0.0,) * axes, (upper + beyond).tolist(), (1.0, 0.8, 0.9)[:axes], degree)
    points = torch.rand(n, axes, generator=generator, dtype=torch.float64) * upper
    draw = torch.rand(n, components, generator=generator, dtype=torch.float64)
    weight = torch.rand(n, generator=generator, dtype=torch.float64)
    return knots, points, draw, weight, components


def blocks_of(axes, degree=3, beyond=0.0):
    """The knots, and one block of each kind by name: a kind added here is tested by every battery."""
    knots, points, draw, weight, components = make(axes, degree, beyond=beyond)
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
