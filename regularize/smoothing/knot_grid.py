"""The knot grid of a fit: of a given distance, of given counts, or by what the samples resolve and what it costs."""

from dataclasses import replace

import torch

from regularize.basis.knots import Knots
from regularize.basis.sampling import space_steps, time_step
from regularize.errors import InvalidInput
from regularize.options import BY_DATA, SAMPLES_PER_KNOT, SplineOptions
from regularize.rows.operators import System, VectorRows
from regularize.solvers.memory import factor_work

from .samples import FitData

MOST_UNKNOWNS = 20_000_000  # 160 MB a vector; more is a mistake of units
# Operations per sample of a factorisation with automatic knots, so that its time is in proportion to the samples. Three
# samples between knots take 1e6 with 10,000 samples and 2e6 with 100,000.
WORK_PER_SAMPLE = 5e6
WORK_FREE = 1e10  # a second or two
WIDER = 1.1  # at a time


def knots_for(data: FitData, options: SplineOptions, per_knot: float = SAMPLES_PER_KNOT) -> Knots:
    """The knot grid around the data.

    Args:
        data: samples, walls and the box.
        options: knots or nodes, and the degree.
        per_knot: samples to a knot where the data decide.

    Raises:
        InvalidInput: a distance that is missing or fits neither the axes nor the memory.
    """
    sides = [b - a for a, b in zip(data.lower, data.upper, strict=True)]
    if options.nodes is not None:
        if data.over_time:
            raise InvalidInput("nodes fixes a grid in space alone: over time give knots and time_knots")
        return _guarded(_knots_of_counts(data, options.nodes, sides, options.degree), data.components)
    if options.knots != BY_DATA:
        return _covering(data, options, sides)
    each = options.knots_at(options.spacing or space_steps(data.points[:, : data.components]), per_knot)
    while True:
        knots = _covering(data, replace(options, knots=each), sides)
        if _work(knots, data) <= max(WORK_FREE, WORK_PER_SAMPLE * len(data.points)):
            return knots
        each = tuple(WIDER * distance for distance in each)


def _covering(data: FitData, options: SplineOptions, sides: list[float]) -> Knots:
    """Knots of the distances that the options hold."""
    if isinstance(options.knots, tuple | list):
        each = [float(distance) for distance in options.knots]
    else:
        each = [float(options.knots or 0.0)] * data.components
    if data.over_time:
        if options.time_knots is None:
            raise InvalidInput("points hold a time column: give time_knots, the knot distance in s")
        frames = options.time_knots == BY_DATA
        each.append(SAMPLES_PER_KNOT * time_step(data.points[:, -1]) if frames else float(options.time_knots))
    if len(each) != len(sides):
        raise InvalidInput(f"knots has {len(each)} entries for {len(sides)} axes")
    return _guarded(Knots.covering(data.lower, data.upper, each, options.degree), data.components)


def _guarded(knots: Knots, components: int) -> Knots:
    """The same knots, unless they are more than any machine should be asked for."""
    unknowns = knots.nodes * components
    if unknowns > MOST_UNKNOWNS:
        raise InvalidInput(
            f"knots of {knots.spacing} over a box of {knots.cells} cells ask for {unknowns:.2g} unknowns, more than "
            f"{MOST_UNKNOWNS:.2g}: give a larger knot distance (it is in m), or a smaller box"
        )
    return knots


def _work(knots: Knots, data: FitData) -> float:
    """Operations of a factorisation for the coefficients that the samples touch."""
    silent = torch.zeros_like(data.velocity)
    return factor_work(System(knots, data.components, [VectorRows(knots, data.points, silent, silent)], 0.0))


def _knots_of_counts(data: FitData, nodes: tuple[int, ...], sides: list[float], degree: int) -> Knots:
    """As many coefficients as asked for, the longest side first."""
    if len(nodes) < len(sides):
        raise InvalidInput(f"nodes has {len(nodes)} entries for {len(sides)} axes")
    counts = sorted(nodes, reverse=True)[: len(sides)]
    cells = [0] * len(sides)
    for rank, axis in enumerate(sorted(range(len(sides)), key=lambda k: -sides[k])):
        cells[axis] = counts[rank] - degree
    longest = max(max(sides), 1e-12)
    # A box flat along an axis still needs a positive spacing there.
    step = [max(side, 1e-3 * longest) / n for side, n in zip(sides, cells, strict=True)]
    origin = [(a + b - n * h) / 2 for a, b, n, h in zip(data.lower, data.upper, cells, step, strict=True)]
    return Knots(tuple(origin), tuple(step), tuple(cells), degree)
