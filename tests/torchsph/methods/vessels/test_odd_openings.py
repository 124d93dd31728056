"""Forecasts through openings of every awkward kind: none fails, leaks particles or breaks continuity."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from ellipsoid_cases import TIMES, recorded

import geometry
import torchsph as ts
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.validation.ellipsoid import LEAK, OPENING, PulsatingEllipsoid

SPACING = 2.5e-3
THIRD = 3


@pytest.fixture(scope="module")
def leaking() -> geometry.Recording:
    return recorded(PulsatingEllipsoid(leak=0.2))


def relabelled(recording: geometry.Recording, choose, label: int = THIRD) -> geometry.Recording:
    """Faces of the upper opening for which ``choose(centroids)`` is true become an opening of their own."""
    surface = recording.wall.at(0)
    chosen = (surface.region == OPENING) & choose(surface.centroids)
    assert chosen.any() and not chosen[surface.region == OPENING].all()
    wall = replace(recording.wall, region=np.where(chosen, label, surface.region).astype(np.uint8))
    return replace(recording, wall=wall)


def opened(recording: geometry.Recording, *rows: tuple[float, float, float]) -> geometry.Recording:
    return replace(recording, valve_intervals=np.array(rows, np.float64).reshape(-1, 3))


def inner(centroids: np.ndarray) -> np.ndarray:
    return np.hypot(centroids[:, 0], centroids[:, 1]) < 2.2e-3


def tiny(centroids: np.ndarray) -> np.ndarray:
    return np.hypot(centroids[:, 0] - 2.5e-3, centroids[:, 1]) < 0.7e-3


def half(centroids: np.ndarray) -> np.ndarray:
    return centroids[:, 0] > 0


CASES = {
    "three openings": (inner, [(OPENING, 0, 1), (LEAK, 0, 1), (THIRD, 0, 1)]),
    "one in the ring of another": (inner, [(OPENING, 0, 1), (THIRD, 0, 1)]),
    "the ring alone": (inner, [(OPENING, 0, 1)]),
    "openings that touch": (half, [(OPENING, 0, 1), (THIRD, 0, 1), (LEAK, 0, 1)]),
    "smaller than a particle": (tiny, [(OPENING, 0, 1), (THIRD, 0, 1)]),
    "two in turn": (half, [(OPENING, 0, 0.035), (THIRD, 0.035, 1), (LEAK, 0, 1)]),
    "open for less than a step": (half, [(OPENING, 0, 1), (THIRD, 0.03512, 0.03514), (LEAK, 0.03513, 0.0352)]),
}


@pytest.mark.parametrize("name", CASES)
def test_a_forecast_goes_through(leaking, name):
    choose, rows = CASES[name]
    recording = opened(relabelled(leaking, choose), *rows)
    model = ts.make_model(recording, spacing=SPACING)
    masks = torch.from_numpy(np.array(recording.mask))
    start = torch.from_numpy(recording.velocity[0])
    going = GridForecast(model, recording.grid, start, masks[0], float(TIMES[0]), Transfer(fade=None))
    value, covered = going.at(float(TIMES[1]), masks[1])
    assert bool(torch.isfinite(value).all()) and bool(covered[0][masks[1]].all())
    assert float(value.abs().max()) < 3.0 and int(going.run.record.outside.sum()) == 0
    assert going.run.record.filling.item() == pytest.approx(1.0, abs=0.08)


@pytest.mark.slow
def test_one_frame_alone_is_smoothed(leaking):
    """A wall that is known at one time stands still; what its openings pass is for the data to say."""
    alone = leaking.select([0])
    found = ts.smooth(alone)
    inside = np.broadcast_to(alone.mask[:, None], alone.velocity.shape)
    wrong = np.linalg.norm((found.velocity - alone.velocity)[inside])
    assert wrong < 0.35 * np.linalg.norm(alone.velocity[inside])
