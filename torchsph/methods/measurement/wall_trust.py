"""How far the walls of a vessel can be believed, from what its velocities say without them.

A wall that was drawn from a mask has steps, and one that stands a voxel too far inwards has flow along it and through
it. Where several openings are open, nothing holds the flow together but such walls and the data: the splines are made
without walls first, and what they pass through the wall beyond their own uncertainty is taken for the wall's error.
"""

from __future__ import annotations

import math

from regularize import SplineField, WallRows


def wall_trust(field: SplineField, rows: WallRows, strength: float) -> float:
    """Factor in (0, 1] on the squares of the rows of the normal velocity at shut walls.

    The rows stand for an error of noise / ``strength`` each; what they are found to be off by beyond that and beyond
    the spline's own deviation is added to it in squares. A wall that stands wrong does so for a whole patch, whose rows
    say it only once: a patch of a knot's size has the error of the mean of its N rows, noise / (``strength`` N^1/2).

    Args:
        field: of samples alone, with ``uncertainty=True`` and an automatic choice.
        rows: the walls at its frame.
        strength: of the rows (``Smoother.wall``).
    """
    points = rows.points[rows.no_slip]
    known = field.supported(points)
    if field.choice is None or not bool(known.any()):
        return 1.0
    normals, area = rows.normals[rows.no_slip][known], rows.weight[rows.no_slip][known]
    through = (normals * (field(points[known]) - rows.velocity[rows.no_slip][known])).sum(1)
    own = (normals * field.std(points[known])).square().sum(1)
    beyond = float((area * (through.square() - own)).sum() / area.sum())
    noise = float(field.choice.deviation.square().mean())
    patch = sorted(field.knots.spacing[: points.shape[1]])[: points.shape[1] - 1]
    count = max(math.prod(patch) / float(area.mean()), 1.0)
    return 1.0 / (1.0 + count * strength**2 * max(beyond, 0.0) / noise)
