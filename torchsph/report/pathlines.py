"""Pathlines for a moving picture: tracers that always fill the blood, renewed as they leave or grow old.

A tracer that left through an orifice, or has been shown for long enough, begins anew at a place that has none: so the
blood that comes in gets its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

import geometry
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics.lagrangian.moving_flow import MovingFlow, MovingWalls
from torchsph.haemodynamics.lagrangian.tracers import carry

from .packing import Packed, packed_numbers, packed_places

COARSER = 1.8
LIFE = 0.4
"""Longest life of a tracer, of the time that the recording covers."""


@dataclass(frozen=True)
class Pathlines:
    """Places of tracers over time.

    Args:
        time: (K,), s.
        places: (K, n, D), m.
        begins: (K, n) bool, where a tracer begins anew: no line leads there.
    """

    time: np.ndarray
    places: np.ndarray
    begins: np.ndarray

    def packed(self) -> dict[str, Packed | list[float]]:
        """As a page takes it."""
        return {
            "time": [float(t) for t in self.time],
            "places": packed_places(self.places),
            "begins": packed_numbers(self.begins),
        }


def pathlines(recording: geometry.Recording, count: int, *, steps: int = 2, seed: int = 0) -> Pathlines:
    """Tracers over all frames.

    Args:
        recording: the flow, with its walls where it has some.
        count: tracers that are shown at a time.
        steps: places that are kept for each frame interval.
        seed: of where they begin.

    Raises:
        ValueError: fewer than two frames, or one without blood.
    """
    generator = np.random.default_rng(seed)
    mask, time = np.asarray(recording.mask, bool), np.asarray(recording.time)
    events = [float(t) for t in np.unique(recording.valve_intervals_or_derived()[:, 1:]) if np.isfinite(t)]
    flow = MovingFlow(recording.grid, time, filled_velocity(recording), mask, events=events, dtype=torch.float32)
    walls = None if recording.wall is None else _walls(recording)
    marks = np.interp(np.arange((len(time) - 1) * steps + 1) / steps, np.arange(len(time)), time)
    nodes = recording.grid.nodes().numpy()
    life = max(2, round(LIFE * len(marks)))
    place = _empty_places(recording.grid, nodes, mask[0], np.zeros((0, recording.dimension)), count, generator)
    left = generator.integers(1, life + 1, count)  # kept steps that are left of each life
    places, begins = [place], [np.ones(count, bool)]
    for number in range(1, len(marks)):
        done = carry(flow, place, float(marks[number - 1]), float(marks[number]), walls=walls)
        left = left - 1
        over = (done.left_through.numpy() > 0) | (left <= 0)
        place = done.positions.numpy().astype(np.float64)
        inside = mask[min(int(np.searchsorted(time, marks[number] - 1e-12)), len(time) - 1)]
        if over.any() and inside.any():
            place = place.copy()
            place[over] = _empty_places(recording.grid, nodes, inside, place[~over], int(over.sum()), generator)
            left[over] = life
        places.append(place)
        begins.append(over)
    return Pathlines(marks, np.stack(places), np.stack(begins))


def _walls(recording: geometry.Recording) -> MovingWalls:
    """Walls for a picture: their distance on coarser nodes than tracers for numbers need, for a fifth of the time."""
    motion, step = geometry.WallMotion.from_recording(recording), COARSER * min(recording.grid.spacing)
    grid = geometry.Grid.covering(recording.grid.origin, recording.grid.upper, step).padded(1)
    distance = geometry.MovingDistance(grid, motion, band=3 * step, keep=4, travel=np.inf)
    return MovingWalls(distance, geometry.orifices(motion), recording.valve_intervals_or_derived())


def _empty_places(
    grid: geometry.Grid,
    nodes: np.ndarray,
    inside: np.ndarray,
    taken: np.ndarray,
    count: int,
    generator: np.random.Generator,
) -> np.ndarray:
    """Places (count, D), m, in cells of the blood with as few tracers `taken` (n, D), m, as there are."""
    cells = np.flatnonzero(inside)
    crowd = np.zeros(grid.size)
    if len(taken):
        shape = np.array(grid.shape)
        index = np.round((taken - np.array(grid.origin)) / np.array(grid.spacing)).astype(int)[:, ::-1]
        np.add.at(crowd, np.ravel_multi_index(tuple(np.clip(index, 0, shape - 1).T), grid.shape), 1)
    order = np.argsort(crowd[cells] + generator.random(len(cells)), kind="stable")
    chosen = cells[np.resize(order, count)]
    jitter = generator.random((count, grid.dimension)) - 0.5
    return np.asarray(nodes[chosen] + jitter * np.array(grid.spacing), np.float64)
