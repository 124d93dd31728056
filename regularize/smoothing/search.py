"""The automatic choice for one set of samples: row groups on a coarser grid, and the search on them."""

from dataclasses import replace

import torch

from regularize.basis.knots import Knots
from regularize.options import SplineOptions, length_of
from regularize.rows.operators import CellRows, DivergenceRows, VectorRows
from regularize.rows.penalties import row_factor
from regularize.solvers.direct import solve_direct
from regularize.statistics.extrapolation import Extrapolation
from regularize.statistics.gcv import cross_validate
from regularize.statistics.likelihood import Choice, LikelihoodSearch, Start
from regularize.statistics.row_groups import Groups

from .problem import Problem
from .row_blocks import build_system, penalty_blocks, smoothness_gram, wall_roots
from .samples import FitData

FEWEST = 30  # below this the estimates scatter by more than the choice could gain
COARSER = 1.5  # the search begins on knots so much farther apart, where a round costs a fraction
WORTH_COARSER = 600  # unknowns above which it does


def choose(options: SplineOptions, knots: Knots, data: FitData) -> Choice | None:
    """Choose noise levels, curvature, no_slip and robust factors for ``data`` (see ``likelihood``).

    None where there is nothing to choose from: fewer than FEWEST samples, or no flow at all.
    """
    data = data.cpu()  # small dense work, and LAPACK's banded routines
    guess = 0.5 * float(data.velocity.double().square().mean().sqrt())
    if len(data.points) < FEWEST or guess == 0:
        return None
    coarse = knots.spread_out(options.search_knots)
    with torch.no_grad():
        search = _search(options, coarse, data)
        if options.automatic == "gcv":
            return cross_validate(search, options.no_slip, options.rounds)
        divergence = length_of(options.divergence) if options.divergence is not None else None
        start = Start(guess, length_of(options.curvature), options.no_slip, divergence)
        if search.unknowns > WORTH_COARSER:
            fewer = _search(options, knots.spread_out(COARSER * options.search_knots), data)
            start = fewer.run(start, options.rounds).start
            search.ahead = Extrapolation(fewer.ahead)  # near the end both move alike
        choice = search.run(start, options.rounds)
        return _counting_shared_errors(options, coarse, data, choice) if options.correlated else choice


def _search(options: SplineOptions, coarse: Knots, data: FitData) -> LikelihoodSearch:
    """The search on the rows of a knot grid."""
    fit = VectorRows(coarse, data.points, data.velocity, data.weight[:, None])
    rest = options.fixed(no_slip=None, curvature=None, choose_divergence=False)
    free = options.choose_divergence and bool(options.divergence)
    rest = replace(rest, divergence=1.0) if free else rest
    blocks, cells, damping = penalty_blocks(rest, coarse, data, [fit])
    chosen = [block for block in blocks if free and isinstance(block, DivergenceRows | CellRows)]
    slip = None
    if options.no_slip and data.wall is not None and bool(data.wall.no_slip.any()):
        wall, held = data.wall, data.wall.no_slip
        slip = VectorRows(coarse, wall.points[held], wall.velocity[held], wall_roots(wall)[held, None])
    factor = row_factor(smoothness_gram(options, coarse, data)) / data.extent(coarse) ** 0.5
    groups = Groups(
        options.order,
        data.points,
        data.velocity,
        data.weight,
        CellRows(coarse, cells, factor, 1),
        slip,
        chosen[0] if chosen else None,
        [block for block in blocks if block not in chosen],
        damping,
    )
    return LikelihoodSearch(coarse, groups, options.robust)


def _counting_shared_errors(options: SplineOptions, coarse: Knots, data: FitData, choice: Choice) -> Choice:
    """The choice with what neighbouring samples' errors are found to have in common in a fit on the search's grid."""
    data = data.reweighed(choice)
    problem = Problem(data, build_system(options.with_choice(choice), coarse, data), choice)
    solution, factor = solve_direct(problem.system, strict=False)
    shared = None if factor is None else problem.shared(solution, factor)
    return choice if shared is None else choice.counting(shared)
