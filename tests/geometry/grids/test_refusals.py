"""Slips of a caller of grids and bodies: each is refused by its name, and none makes a computer busy for minutes."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

import geometry

GRID = geometry.Grid((0.0, 0.0), (1e-3, 1e-3), (4, 5))
FIELD, POINTS = torch.rand(2, 4, 5), 3e-3 * torch.rand(7, 2)
NAN = math.nan
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])

REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "text": (lambda: geometry.Grid(("a", 0.0), (1.0, 1.0), (2, 2)), "Grid: origin must be numbers, not"),
    "no number": (lambda: geometry.Grid((0.0, 0.0), (NAN, 1.0), (2, 2)), "Grid: spacing must be finite"),
    "half a node": (lambda: geometry.Grid((0.0, 0.0), (1.0, 1.0), (2, 2.5)), "Grid: shape must be whole numbers"),
    "endless box": (lambda: geometry.Grid.covering((0, 0), (math.inf, 1), 0.1), "upper must be finite"),
    "one side": (lambda: geometry.Grid.covering((0, 0), (1,), 0.1), "as many numbers, not 2, 1 and 2"),
    "whole field": (lambda: GRID.sample(FIELD.long(), POINTS), "the field must be floating point, not torch.int64"),
    "sparse field": (
        lambda: GRID.sample(FIELD.to_sparse(), POINTS),
        "field must be a dense tensor of real numbers, got a tensor .*, sparse_coo",
    ),
    "points of numpy": (
        lambda: GRID.sample(FIELD, POINTS.numpy()),
        r"points must be a dense tensor of real numbers or a Stencil, got an array \(ndarray\) of float32",
    ),
    "meta points": (lambda: GRID.contains(POINTS.to("meta")), "points must be a dense tensor"),
    "no margin": (lambda: GRID.contains(POINTS, margin=None), "margin must be a number, got None"),
    "padding": (lambda: GRID.padded(0.5), "nodes must be a whole number"),
    "huge ellipse": (lambda: geometry.ellipse((300.0, 0.1), 1e-3), "pieces, more than 20000; both in m"),
    "fine ball": (lambda: geometry.ellipsoid((1.0,) * 3, 1e-12), "pieces, more than 20000"),
    "ellipse of nothing": (lambda: geometry.ellipse((1.0, 1.0), 0.0), "ellipse: spacing must be 1 positive"),
    "centre": (lambda: geometry.ellipse((1.0, 1.0), 0.1, (0.0,)), "ellipse: centre must be 2 numbers"),
    "corner": (lambda: geometry.box((0, 0), (1, 1, 1), 0.5), "box: lower must be 3 numbers"),
    "corners": (lambda: geometry.polygon(SQUARE * NAN, 0.1), "corners must be finite"),
    "profile": (lambda: geometry.revolved(SQUARE * NAN, 0.1), "the profile must be finite"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def test_no_point_is_sampled_as_nothing() -> None:
    assert GRID.sample(FIELD, POINTS[:0]).shape == (2, 0)
    assert not GRID.spread(FIELD[:, 0, :0], POINTS[:0]).any()


def test_frames_that_there_are_not(box_recording: Callable[..., geometry.Recording]) -> None:
    recording = box_recording(lambda points, t: 0 * points, nodes=4)
    for frames in (99, [99], [0.5], [True], ["a"]):
        with pytest.raises(ValueError, match="frames must be a slice, numbers from 0 to"):
            recording.select(frames)
    assert recording.select([0, -1]).frames == 2 and recording.select(slice(1, None)).frames == recording.frames - 1


BALL = geometry.ellipsoid((1e-2,) * 3, 5e-3)
SWAYING = geometry.WallMotion.through(
    np.array([0.0, 0.1]), np.stack([BALL.vertices, BALL.vertices + 1e-3]), BALL.faces, BALL.region
)
ROUND = geometry.Grid((-2e-2,) * 3, (5e-3,) * 3, (9, 9, 9))

ENDLESS: dict[str, tuple[Callable[[], object], str]] = {
    "passes": (lambda: geometry.taubin(BALL, 2**63), "taubin: passes must be from 0 to 10000, got 9223372036854775808"),
    "smoothings": (
        lambda: geometry.surface_from_mask(np.ones(ROUND.shape), ROUND, smoothing=2**63),
        "surface_from_mask: smoothing must be from 0 to 10000",
    ),
    "travel": (lambda: geometry.MovingDistance(ROUND, SWAYING, travel=1e-300), "key times at .* more than 100000"),
    "grids kept": (lambda: geometry.MovingDistance(ROUND, SWAYING, keep=math.inf), "keep must be a whole number"),
    "band": (lambda: geometry.MovingDistance(ROUND, SWAYING, band=NAN), "band must be finite, got nan"),
    "wall points": (lambda: geometry.wall_points(SWAYING, 0.0, 1e-12), "more than 50000000 points: is it in m"),
    "nodes": (lambda: geometry.Grid((0.0,) * 3, (1.0,) * 3, (10**6,) * 3).nodes(), "more nodes than any computer"),
    "winding of nothing": (
        lambda: geometry.winding_number(BALL.vertices * NAN, BALL.faces, np.zeros((1, 3))),
        "winding_number: vertices must be finite",
    ),
    "winding of halves": (
        lambda: geometry.winding_number(BALL.vertices, 0.5 * BALL.faces, np.zeros((1, 3))),
        "winding_number: faces must hold whole numbers, not float64",
    ),
    "winding beyond": (
        lambda: geometry.grid_winding(ROUND, BALL.vertices, BALL.faces + 99),
        "must number vertices 0 to",
    ),
    "flux": (lambda: geometry.OpeningFlux(1, np.array([0.0, NAN])), "/flux/region_1: must be finite at every frame"),
    "share": (lambda: geometry.Ventricle(axial_share=math.inf), "Ventricle: axial_share must be finite, got inf"),
    "spread": (lambda: GRID.spread(FIELD[0, 0, :1] * NAN, POINTS[:1]), "Grid.spread: values must be finite"),
    "spread somewhere": (lambda: GRID.spread(FIELD[0, 0, :1], POINTS[:1] * NAN), "Grid.spread: points must be finite"),
    "lid": (lambda: geometry.with_lids(geometry.Surface(BALL.vertices, BALL.faces[9:]), (300,)), "from 0 to 255"),
    "device": (lambda: geometry.MovingDistance(ROUND, SWAYING, device="chip"), "must be a device of torch"),
    "no grid": (lambda: geometry.signed_distance("grid", BALL), "signed_distance: grid must be a Grid, got 'grid'"),
}


@pytest.mark.parametrize("name", ENDLESS)
def test_it_is_refused_before_it_takes_hours_or_says_nothing(name: str) -> None:
    call, words = ENDLESS[name]
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def test_what_is_not_finite_spoils_its_own_value_alone() -> None:
    points = torch.where(torch.arange(7)[:, None] == 2, NAN, POINTS)
    found, sound = GRID.sample(FIELD, points), GRID.sample(FIELD, POINTS)
    assert bool(found[:, 2].isnan().all()) and torch.equal(found[:, 3:], sound[:, 3:])
