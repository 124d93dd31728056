"""What goes wrong with a lab's recordings, done to a good one: walls that flicker, valves, frames, sectors.

Each case is a function of a recording and a NumPy generator that returns the damaged recording; ``CASES`` names them.
Every function leaves the velocities as they were measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

import geometry

Damage = Callable[[geometry.Recording, np.random.Generator], geometry.Recording]


def _base(vertices: np.ndarray, region: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(D,) the middle of the openings' vertices of one frame: what the walls are scaled about."""
    return vertices[np.unique(faces[region > 0])].mean(0)


def _with_walls(recording: geometry.Recording, vertices: np.ndarray) -> geometry.Recording:
    """The recording with other wall positions; velocities of the walls that were given no longer hold."""
    return replace(recording, wall=replace(recording.wall, vertices=vertices, velocity=None))


def scaled(recording: geometry.Recording, factors: np.ndarray) -> geometry.Recording:
    """Walls scaled in each frame by factors (T,), about the middle of their base, which stays in its plane."""
    wall = recording.wall
    vertices = np.array(wall.vertices)
    for frame, factor in enumerate(factors):
        middle = _base(vertices[frame], wall.region, wall.faces)
        vertices[frame] = middle + factor * (vertices[frame] - middle)
    return _with_walls(recording, vertices)


def flicker(amplitude: float) -> Damage:
    """Walls whose farthest point is off by an independent ``amplitude`` (m, RMS) in each frame, by scaling."""

    def damaged(recording: geometry.Recording, generator: np.random.Generator) -> geometry.Recording:
        wall = recording.wall
        base = _base(wall.vertices[0], wall.region, wall.faces)
        reach = float(np.linalg.norm(wall.vertices[0] - base, axis=1).max())
        return scaled(recording, 1.0 + amplitude / reach * generator.standard_normal(recording.frames))

    return damaged


def constant_scale(factor: float) -> Damage:
    """Walls too small or too large by the same factor in every frame."""
    return lambda recording, generator: scaled(recording, np.full(recording.frames, factor))


def bumps(amplitude: float, reach: float = 6e-3) -> Damage:
    """Smooth bumps of ``amplitude`` (m, RMS) along the normals, the same in every frame, correlated over ``reach`` (m).

    The base plane stays.
    """

    def damaged(recording: geometry.Recording, generator: np.random.Generator) -> geometry.Recording:
        wall = recording.wall
        first = wall.at(0)
        waves = generator.standard_normal((200, first.dimension)) / reach
        phase = generator.uniform(0.0, 2.0 * np.pi, 200)
        height = np.sqrt(2.0 / 200) * np.cos(first.vertices @ waves.T + phase).sum(1)
        height[np.unique(wall.faces[wall.region > 0])] = 0.0
        lowest = first.vertices[np.unique(wall.faces[wall.region > 0])]
        away = np.abs((first.vertices - lowest.mean(0)) @ _axis(first, wall.region))
        height *= np.clip(away / reach, 0.0, 1.0)
        vertices = np.array(wall.vertices)
        for frame in range(recording.frames):
            vertices[frame] += amplitude * height[:, None] * _vertex_normals(wall.at(frame))
        return _with_walls(recording, vertices)

    return damaged


def _axis(surface: geometry.Surface, region: np.ndarray) -> np.ndarray:
    """(D,) unit vector out of the openings, the mean of their area vectors."""
    vector = surface.area_vectors[region > 0].sum(0)
    return vector / np.linalg.norm(vector)


def _vertex_normals(surface: geometry.Surface) -> np.ndarray:
    """(nv, D) unit normals, weighted by area."""
    total = np.zeros_like(surface.vertices)
    for corner in range(surface.faces.shape[1]):
        np.add.at(total, surface.faces[:, corner], surface.area_vectors)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)


def valves_shifted(seconds: float) -> Damage:
    """Valve times late by ``seconds`` (early where negative)."""

    def damaged(recording: geometry.Recording, generator: np.random.Generator) -> geometry.Recording:
        intervals = np.array(recording.valve_intervals_or_derived())
        intervals[:, 1:] += seconds
        return replace(recording, valve_intervals=intervals, valve_open=None)

    return damaged


def without_valve_times(recording: geometry.Recording, generator: np.random.Generator) -> geometry.Recording:
    """No word of when the valves are open."""
    return replace(recording, valve_intervals=None, valve_open=None)


def frames_lost(share: float) -> Damage:
    """A share of the frames, chosen at random, is not there; the first and the last are."""

    def damaged(recording: geometry.Recording, generator: np.random.Generator) -> geometry.Recording:
        inner = np.arange(1, recording.frames - 1)
        lost = generator.choice(inner, size=round(share * recording.frames), replace=False)
        kept = np.setdiff1d(np.arange(recording.frames), lost)
        return recording.select(kept)

    return damaged


def half_of_the_sector(recording: geometry.Recording, generator: np.random.Generator) -> geometry.Recording:
    """Nothing measured at x above the middle of the grid."""
    weight = np.array(recording.weight)
    weight[..., recording.grid.shape[-1] // 2 :] = 0.0
    return replace(recording, weight=weight)


CASES: dict[str, Damage] = {
    "as it is": lambda recording, generator: recording,
    "walls flicker by .25 mm": flicker(0.25e-3),
    "walls flicker by .5 mm": flicker(0.5e-3),
    "walls with bumps of .8 mm": bumps(0.8e-3),
    "walls too small, .94": constant_scale(0.94),
    "walls too large, 1.06": constant_scale(1.06),
    "valves 10 ms early": valves_shifted(-0.01),
    "valves 10 ms late": valves_shifted(0.01),
    "no valve times": without_valve_times,
    "30 % of the frames lost": frames_lost(0.3),
    "half of the sector missing": half_of_the_sector,
}
