"""Fields are brought to conserve mass between moving walls, and changed no further than that."""

from __future__ import annotations

import numpy as np
import pytest
from haemodynamics_cases import ball, hill_vortex, on_grid, order, sphere_points, walls_of_box

import geometry
from torchsph.haemodynamics.fields.continuity import MassBalance


def sphere(spacing, velocity):
    """Wall points of the unit sphere that moves with `velocity` (n, 3) -> (n, 3)."""
    points = sphere_points(spacing)
    areas = np.full(len(points), 4 * np.pi / len(points))
    return geometry.WallPoints(points, points, velocity(points), areas, np.zeros(len(points), int))


def off(found, exact, mask):
    return float(np.linalg.norm((found - exact)[:, mask]) / np.linalg.norm(exact[:, mask]))


def test_blood_at_rest_in_a_moving_ball_moves_with_it():
    """The irrotational flow in a closed cavity that is carried along is uniform (Batchelor 1967, sec. 6.8)."""
    drift, errors, spacings = np.array([0.3, -0.2, 0.5]), [], [0.2, 0.1, 0.05]
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        balance = MassBalance(grid, mask, sphere(0.5 * spacing, lambda p: np.tile(drift, (len(p), 1))))
        exact = on_grid(grid, np.tile(drift, (len(points), 1)), mask)
        errors.append(off(balance.nearest(0 * exact), exact, mask))
    assert order(spacings, errors) > 0.8 and errors[-1] < 0.01


def test_a_vortex_that_obeys_its_walls_stays():
    """Hill's vortex passes nothing through its sphere: what is changed falls with the spacing, down to a percent."""
    errors, spacings = [], [0.2, 0.1, 0.05]
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        exact = on_grid(grid, hill_vortex(points), mask)
        errors.append(off(MassBalance(grid, mask, sphere(0.5 * spacing, np.zeros_like)).nearest(exact), exact, mask))
    assert order(spacings, errors) > 0.8 and errors[-1] < 0.015


def box(step, size=0.01):
    """A box whose nodes lie half a step from its walls."""
    grid = geometry.Grid.covering((0.0,) * 3, (size,) * 3, step)
    grid = geometry.Grid(tuple(o + 0.5 * step for o in grid.origin), grid.spacing, grid.shape)
    points = grid.nodes().numpy()
    return grid, points, ((points > 0) & (points < size)).all(1).reshape(grid.shape)


def test_what_a_piston_displaces_leaves_through_the_open_lid():
    """Blood at rest over a rising floor: the nearest flow is uniform; half an open lid takes as much of every layer."""
    step, size, rise = 5e-4, 0.01, 0.2
    grid, points, mask = box(step, size)
    wall, still = walls_of_box(size, 0.5 * step, rise), np.zeros((3, *grid.shape))
    exact = on_grid(grid, np.tile([0, 0, rise], (len(points), 1)), mask)
    whole = MassBalance(grid, mask, wall, (1, 2))
    assert off(whole.nearest(still), exact, mask) < 0.01
    half = MassBalance(grid, mask, wall, [1]).nearest(still)
    planes = half[2].sum((1, 2))[mask.any((1, 2))] * step**2  # m3/s upwards through every layer of nodes
    assert planes[:-4] == pytest.approx(rise * size**2, rel=0.02)


def test_only_the_balance_of_mass_is_mended():
    """A swirl that passes half of what the floor displaces: the flow comes back whole, the swirl stays."""
    step, size, rise = 5e-4, 0.01, 0.2
    grid, points, mask = box(step, size)
    wall = walls_of_box(size, 0.5 * step, rise)
    x, y = np.pi * points[:, 0] / size, np.pi * points[:, 1] / size
    swirl = 0.3 * np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0 * x], 1)
    up = np.tile([0, 0, rise], (len(points), 1))
    balance = MassBalance(grid, mask, wall, (1, 2))
    exact = on_grid(grid, swirl + up, mask)
    given = np.stack([on_grid(grid, swirl + share * up, mask) for share in (0.5, 1.0)])
    found = balance.nearest(given)
    assert off(given[0], exact, mask) > 0.3
    assert [off(one, exact, mask) for one in found] == pytest.approx([0, 0], abs=0.02)
    # differences of such fields obey walls at rest
    apart = balance.nearest(given[0] - given[1], at_rest=True)
    np.testing.assert_allclose(apart, found[0] - found[1], atol=1e-9)
    # and what obeys them already is not changed again
    again = balance.nearest(found[0])
    assert off(again, found[0], mask) < 2e-3


def test_a_closed_cavity_whose_volume_changes_has_a_field():
    """Wall data that cannot hold (a floor that rises under a shut lid) move nothing without bound."""
    grid, _, mask = box(1e-3)
    balance = MassBalance(grid, mask, walls_of_box(0.01, 5e-4, 0.2))
    found = balance.nearest(np.zeros((3, *grid.shape)))
    assert np.abs(found).max() < 0.4
    assert np.abs(found[:, ~mask]).max() == 0
    with pytest.raises(ValueError, match="no node"):
        MassBalance(grid, np.zeros(grid.shape, bool), walls_of_box(0.01, 5e-4, 0.2))
