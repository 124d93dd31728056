"""Holes are closed along themselves: never by a fan through the fluid or outside of it."""

from __future__ import annotations

import numpy as np
import pytest

from geometry import Grid, Surface, SurfaceError, repaired, signed_distance
from geometry.surfaces.holes import least_area_triangles, star_shaped

ANGLE = np.linspace(np.radians(30), np.radians(330), 31)
RING = np.concatenate([0.02 * np.c_[np.cos(ANGLE), np.sin(ANGLE)], 0.012 * np.c_[np.cos(ANGLE), np.sin(ANGLE)][::-1]])


def _polygon_area(ring: np.ndarray) -> float:
    x, y = ring.T
    return 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def _area(rim: np.ndarray, triangles: np.ndarray) -> float:
    a, b, c = (rim[triangles[:, k]] for k in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _open_prism(ring: np.ndarray, height: float) -> Surface:
    """Bottom and sides of a prism, without its top."""
    count = len(ring)
    vertices = np.concatenate([np.c_[ring, np.zeros(count)], np.c_[ring, np.full(count, height)]])
    sides = []
    for i in range(count):
        j = (i + 1) % count
        sides += [[i, j, count + j], [i, count + j, count + i]]
    bottom = least_area_triangles(vertices[:count])[:, ::-1]
    return Surface(vertices, np.concatenate([np.array(sides), bottom]))


def test_the_least_area_in_a_plane_is_the_polygon() -> None:
    draw = np.random.default_rng(0)
    star = (1 + 0.6 * np.sin(7 * np.arange(40) * 2 * np.pi / 40))[:, None] * np.c_[
        np.cos(np.arange(40) * 2 * np.pi / 40), np.sin(np.arange(40) * 2 * np.pi / 40)
    ]
    turn = np.linalg.qr(draw.normal(size=(3, 3)))[0]
    for ring in (RING, star):
        rim = np.c_[ring, np.zeros(len(ring))] @ turn.T
        triangles = least_area_triangles(rim)
        assert len(triangles) == len(ring) - 2
        assert _area(rim, triangles) == pytest.approx(_polygon_area(ring), rel=1e-9)


def test_a_c_shaped_hole_has_no_wall_in_its_empty_middle() -> None:
    surface = repaired(_open_prism(RING, 0.01), hole_region=3)
    surface.check()
    area = _polygon_area(RING)
    assert surface.volume == pytest.approx(0.01 * area, rel=1e-9)
    assert surface.areas[surface.region == 3].sum() == pytest.approx(area, rel=1e-9)
    grid = Grid((-0.006, -0.006, 0.01), (0.002,) * 3, (1, 7, 7))
    assert np.abs(signed_distance(grid, surface)).min() > 0.003  # the inner rim is 12 mm from the axis


def test_round_holes_keep_their_fan() -> None:
    ring = 0.01 * np.c_[np.cos(ANGLE[:-1] * 1.2), np.sin(ANGLE[:-1] * 1.2)]
    assert star_shaped(np.c_[ring, np.zeros(30)])
    assert not star_shaped(np.c_[RING, np.zeros(62)])
    saddle = np.c_[ring, 0.002 * np.cos(2 * np.arctan2(ring[:, 1], ring[:, 0]))]
    assert star_shaped(saddle)


def test_a_rim_of_too_many_vertices_is_refused() -> None:
    fine = np.linspace(np.radians(30), np.radians(330), 400)
    ring = np.concatenate([np.c_[np.cos(fine), np.sin(fine)], 0.6 * np.c_[np.cos(fine), np.sin(fine)][::-1]])
    with pytest.raises(SurfaceError, match="800 vertices"):
        least_area_triangles(np.c_[ring, np.zeros(800)])
