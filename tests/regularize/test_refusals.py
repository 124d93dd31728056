"""What compiled code would read out of bounds, or compute nonsense from, is refused by its name where it enters."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from regularize import (
    CellRows,
    DirectionRows,
    DivergenceRows,
    Factor,
    InvalidInput,
    Knots,
    LinearData,
    PreparedSystem,
    Smoother,
    System,
    VectorRows,
    basis,
    fit_windows,
    lsmr,
    lsqr,
)
from regularize.native import library as native
from regularize.solvers.direct import solve_direct

KNOTS = Knots((0.0, 0.0, 0.0), (0.005,) * 3, (2, 3, 2), 3)
FINER = Knots((0.0, 0.0, 0.0), (0.0025,) * 3, (4, 6, 4), 3)
DRAW = torch.Generator().manual_seed(0)
POINTS = torch.rand(40, 3, generator=DRAW, dtype=torch.float64) * 0.01
VALUES = torch.randn(40, 3, generator=DRAW, dtype=torch.float64)
ONES = torch.ones(40, 3, dtype=torch.float64)


def rows(knots: Knots = KNOTS, points: torch.Tensor = POINTS, values: torch.Tensor = VALUES) -> VectorRows:
    return VectorRows(knots, points, values, ONES[: len(points), : values.shape[1]])


def system(*blocks: object, knots: Knots = KNOTS, components: int = 3, damping: float = 1e-3) -> System:
    return System(knots, components, blocks or (rows(knots),), damping)


BAND = PreparedSystem(system()).band()
ORDERING = PreparedSystem(system()).ordering
FACTOR = Factor(BAND.clone(), ORDERING)
RIGHT = torch.ones(len(ORDERING.nodes), 3, dtype=torch.float64)
FITTED = Smoother(knots=0.005, spacing=(0.005,) * 3).fixed().fit(POINTS, VALUES)
TIMED = torch.cat([POINTS, torch.linspace(0.0, 1.0, 40, dtype=torch.float64)[:, None]], 1)
FAR = torch.where(torch.arange(40)[:, None] == 5, math.inf, POINTS)
CELLS = torch.full((2, 3), 99)

REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "no component": (lambda: system(components=0), "needs a component"),
    "other components": (lambda: system(rows(), components=2), "of 3 components, the system of 2"),
    "other knots": (lambda: system(rows(), knots=FINER), "made for other knots"),
    "no row": (lambda: system(rows(points=POINTS[:0], values=VALUES[:0])), "blocks without any row"),
    "damping": (lambda: system(damping=math.nan), "System: damping must be finite, got nan"),
    "meta rows": (
        lambda: system(rows(points=POINTS.to("meta"))),
        "points must be a dense tensor of real numbers, got a tensor .* on meta",
    ),
    "points far away": (lambda: rows(points=FAR), "points must be finite"),
    "whole points": (
        lambda: rows(points=POINTS.long()),
        "dense tensor of real numbers, not .* torch.int64",
    ),
    "values": (lambda: system(rows(values=math.nan * VALUES)), "target or weight that is not finite"),
    "fewer values": (lambda: rows(values=VALUES[:5]), r"target has the shape \(5, 3\): it must be \(40, C\)"),
    "directions": (lambda: DirectionRows(KNOTS, POINTS, VALUES[:3], VALUES[:, 0], ONES[:, 0]), r"\(40, C\) and"),
    "other weights": (lambda: VectorRows(KNOTS, POINTS, VALUES, ONES[:, 0]), r"weight has the shape \(40,\)"),
    "sparse weights": (lambda: VectorRows(KNOTS, POINTS, VALUES, ONES.to_sparse()), "weight must be a dense tensor"),
    "no direction": (
        lambda: DirectionRows(KNOTS, POINTS, FAR, VALUES[:, 0], ONES[:, 0]),
        "direction must be finite",
    ),
    "weights of a divergence": (lambda: DivergenceRows(KNOTS, POINTS, 3, ONES[:5, 0]), r"must be \(40,\)"),
    "points of a divergence": (
        lambda: DivergenceRows(KNOTS, POINTS[:, 0], 3, ONES[:, 0]),
        r"DivergenceRows: points must be of the shape \(n, A\)",
    ),
    "knots of text": (
        lambda: Knots(("0", 0.0, 0.0), (0.005,) * 3, (2, 2, 2)),
        "origin must be a sequence, each a number, got",
    ),
    "endless order": (lambda: basis(torch.zeros(1), 3, 2**63), "order must be from 0 to 6"),
    "endless knots": (lambda: Smoother(knots=1e300), "knots is 1e.300: it must be a positive distance"),
    "divergence nowhere": (lambda: Smoother().fit(POINTS, VALUES, divergence_points=FAR), "points hold NaN or inf"),
    "samples of text": (lambda: Smoother().fit(POINTS, "fast"), "velocity must be a tensor, not str"),
    "cells": (lambda: system(CellRows(KNOTS, CELLS, ONES.new_ones(2, 64), 3)), "cells .99, 99, 99. to"),
    "factor of cells": (lambda: CellRows(KNOTS, CELLS, ONES, 3), r"it must be \(rows, 64\)"),
    "knots": (
        lambda: Knots((math.nan,) * 3, (0.005,) * 3, (2, 2, 2)),
        "Knots: origin must be without NaN, got .nan",
    ),
    "many knots": (lambda: Knots((0.0,) * 3, (1e-9,) * 3, (10**4,) * 3), "than the .* that int32 can number"),
    "short band": (lambda: Factor(BAND[:5].clone(), ORDERING), "a row for each component of the"),
    "narrow band": (lambda: Factor(BAND[:, :5].clone(), ORDERING), "the band is 5 wide, but its columns reach"),
    "whole band": (lambda: Factor(BAND.long(), ORDERING), "the band is of torch.int64"),
    "meta band": (lambda: Factor(BAND.to("meta"), ORDERING), "the band is on the device 'meta'"),
    "strided band": (lambda: Factor(BAND.T.contiguous().T, ORDERING), "the band is not contiguous"),
    "meta right": (
        lambda: FACTOR.solve(RIGHT.to("meta")),
        "right must be a dense tensor of real numbers, got .* on meta",
    ),
    "short right": (lambda: FACTOR.solve(RIGHT[:5]), r"the right-hand side has the shape \(5, 3\)"),
}
MORE: dict[str, tuple[Callable[[], object], str]] = {
    "place": (
        lambda: basis(torch.tensor([math.nan]), 3),
        "basis: t must be floating point, finite and within 1e.06 of 0",
    ),
    "far place": (
        lambda: basis(torch.tensor([1e30]), 3),
        "basis: t must be floating point, finite and within 1e.06 of 0",
    ),
    "number of nothing": (
        lambda: LinearData(POINTS, VALUES, torch.zeros(40).long(), torch.tensor([math.nan]), torch.ones(1)),
        "LinearData: value must be finite, of the shape .n., got a tensor",
    ),
    "number that is not": (
        lambda: LinearData(POINTS, VALUES, torch.ones(40).long(), torch.zeros(1), torch.ones(1)),
        "group numbers the 1 values from 0 on, but runs from 1 to 1",
    ),
    "fewer rows": (
        lambda: LinearData(POINTS, VALUES[:5], torch.zeros(40).long(), torch.zeros(1), torch.ones(1)),
        "do not fit each other",
    ),
    "strength": (lambda: Smoother(curvature=1e300), "curvature is 1e.300: it must be 0, or from 1e-30 to 1e.30"),
    "rounds": (lambda: Smoother(rounds=2**63), "Smoother: rounds must be from 1 to 10000, got 9223372036854775808"),
    "option of text": (lambda: Smoother(wall="strong"), "Smoother: wall must be a number or None, got 'strong'"),
    "outside": (lambda: FITTED(POINTS, outside=None), "outside is None: it must be a number"),
    "points nowhere": (lambda: FITTED(math.nan * POINTS, outside=0.0), "points must be finite"),
    "windows": (
        lambda: fit_windows(Smoother(), TIMED, VALUES, length=1e-9, overlap=0.5e-9),
        "makes more than 100000 of them",
    ),
    "weights of rows": (
        lambda: lsmr(lambda x: x, lambda y: y, torch.ones(5), weight=torch.ones(4)),
        r"weight has the shape \(4,\): it must be that of b, \(5,\)",
    ),
    "iterations": (
        lambda: lsqr(lambda x: x, lambda y: y, torch.ones(5), max_iterations=2**63),
        "lsqr: max_iterations must be from 1 to 1e.06",
    ),
}
NEEDS_COMPILED: dict[str, tuple[Callable[[], object], str]] = {
    "reach": (lambda: native.factorise(BAND.clone(), 50 * FACTOR.reach), "reach must rise"),
    "short reach": (lambda: native.factorise(BAND.clone(), FACTOR.reach[:3]), r"reach has the shape \(3,\)"),
    "ordering": (lambda: PreparedSystem(system(knots=FINER), ORDERING).band(), "cells that the ordering"),
    "smaller ordering": (
        lambda: PreparedSystem(system(), PreparedSystem(system(rows(points=POINTS[:1], values=VALUES[:1]))).ordering),
        "cells that the ordering does not hold",
    ),
    "gradient": (lambda: PreparedSystem(system()).gradient(RIGHT[:5]), r"x has the shape \(5, 3\)"),
    "single gradient": (lambda: PreparedSystem(system()).gradient(RIGHT.float()), "x is of torch.float32"),
    "fewer targets": (
        lambda: PreparedSystem(system()).with_targets(system(rows(points=POINTS[:5], values=VALUES[:5]))).gradient(),
        "the target of a block has the shape",
    ),
}


@pytest.mark.parametrize("name", REFUSED | MORE)
def test_it_is_refused(name: str) -> None:
    call, words = (REFUSED | MORE)[name]
    with pytest.raises(InvalidInput, match=words):
        call()


@pytest.mark.skipif(not native.available(), reason="no compiled library")
@pytest.mark.parametrize("name", NEEDS_COMPILED)
def test_it_is_refused_before_compiled_code(name: str) -> None:
    call, words = NEEDS_COMPILED[name]
    with pytest.raises(InvalidInput, match=words):
        call()


def test_more_components_than_compiled_code_has_room_for_are_solved_by_the_reference() -> None:
    four = torch.cat([VALUES, VALUES[:, :1]], 1)
    wide = System(KNOTS, 4, [VectorRows(KNOTS, POINTS, four, torch.ones_like(four))], 1e-3)
    assert PreparedSystem(wide).engine == "reference"
    found = solve_direct(wide).solution.x.view(KNOTS.nodes, 4)
    alone = solve_direct(system()).solution.x.view(KNOTS.nodes, 3)
    torch.testing.assert_close(found[:, :3], alone, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found[:, 3], found[:, 0])
    if native.available():
        with pytest.raises(InvalidInput, match="compiled code takes up to 3 components"):
            PreparedSystem(wide, engine="native")
