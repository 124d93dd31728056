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
    "sparse field": (lambda: GRID.sample(FIELD.to_sparse(), POINTS), "must be a dense tensor that holds numbers"),
    "points of numpy": (lambda: GRID.sample(FIELD, POINTS.numpy()), "points must be a tensor, not ndarray"),
    "meta points": (lambda: GRID.contains(POINTS.to("meta")), "points must be a dense tensor"),
    "no margin": (lambda: GRID.contains(POINTS, margin=None), "margin must be numbers"),
    "padding": (lambda: GRID.padded(0.5), "nodes must be whole numbers"),
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
