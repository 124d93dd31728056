"""Flow through openings and planes, and the numbers read off their curves."""

from __future__ import annotations

import numpy as np
import pytest
from haemodynamics_cases import ball, hill_vortex, on_grid, order, walls_of_box

import geometry
from torchsph.haemodynamics.fields.sampling import plane_section
from torchsph.haemodynamics.flow_rate import (
    OpeningFlow,
    e_and_a,
    peaks,
    plane_flow,
    regurgitant_fraction,
    regurgitant_volume,
    stroke_volume,
)


def smooth_flow(points, time):
    """Divergence-free for the box test: u_z = 1 + sin(200 x) sin(250 z) and what closes it along y."""
    x, y, z = points.T
    up = 1 + np.sin(200 * x) * np.sin(250 * z)
    return np.stack([0 * x, -250 * y * np.sin(200 * x) * np.cos(250 * z), up], 1)


def test_flow_through_an_opening_converges(box_recording):
    """Q = -integral of u_z over the side z = size of the box, by hand."""
    errors, nodes = [], [8, 16, 32]
    for count in nodes:
        recording = box_recording(smooth_flow, nodes=count, times=(0.0, 0.01))
        wall = geometry.wall_points(geometry.WallMotion.from_recording(recording), 0.0, 0.01 / count)
        wall = wall._replace(velocities=smooth_flow(wall.points, 0.0) * (wall.region == 0)[:, None])
        flow = OpeningFlow(recording.grid, recording.mask[0], wall, 1).rate(recording.velocity[0])
        exact = -(0.01**2 + 0.01 * (1 - np.cos(2)) / 200 * np.sin(2.5))
        errors.append(abs(flow / exact - 1))
    assert order([1 / n for n in nodes], errors) > 1.7 and max(errors) < 3e-3 and errors[-1] < 3e-4


def test_two_openings_share_what_the_walls_sweep():
    """A box whose lower side rises: what leaves through the halves of its lid, by the velocities of both."""
    step, size, rise = 5e-4, 0.01, 0.2
    grid = geometry.Grid.covering((0.0,) * 3, (size,) * 3, step)
    grid = geometry.Grid(tuple(o + 0.5 * step for o in grid.origin), grid.spacing, grid.shape)
    points = grid.nodes().numpy()
    mask = ((points > 0) & (points < size)).all(1).reshape(grid.shape)
    # u_z = rise at the bottom, and at the lid rise (1 + tilt) over one half of x, rise (1 - tilt) over the other
    tilt, z = 0.5, points[:, 2] / size
    profile = np.cos(np.pi * points[:, 0] / size)
    up = rise * (1 + tilt * z * profile)
    across = -rise * tilt * np.sin(np.pi * points[:, 0] / size) / np.pi
    velocity = on_grid(grid, np.stack([across, 0 * up, up], 1), mask)
    wall = walls_of_box(size, 0.5 * step, rise)
    flows = [float(OpeningFlow(grid, mask, wall, region, [3 - region]).rate(velocity)) for region in (1, 2)]
    whole = rise * size**2
    exact = [-whole * (0.5 + tilt / np.pi), -whole * (0.5 - tilt / np.pi)]
    assert sum(flows) == pytest.approx(-whole, rel=0.01)
    assert flows == pytest.approx(exact, rel=0.03)


def test_an_opening_that_moves_with_the_blood_lets_nothing_through(box_recording):
    drift = np.array([0.1, 0.2, -0.3])
    recording = box_recording(
        lambda points, time: np.tile(drift, (len(points), 1)), wall_velocity=lambda v: np.tile(drift, (len(v), 1))
    )
    wall = geometry.wall_points(geometry.WallMotion.from_recording(recording), 0.0, 1e-3)
    opening = OpeningFlow(recording.grid, recording.mask[0], wall, 1)
    assert opening.rate(recording.velocity[0]) == pytest.approx(0, abs=1e-12)
    assert opening.rate(np.stack([recording.velocity[0]] * 2)) == pytest.approx(np.zeros(2), abs=1e-12)
    with pytest.raises(ValueError, match="no region 2"):
        OpeningFlow(recording.grid, recording.mask[0], wall, 2)


def test_flow_through_a_plane_of_hills_vortex():
    """The upward flow inside r = a / sqrt 2 at z = 0 returns outside it: the net is 0, the inner pi 3/8 U a^2."""
    grid, points, mask = ball(0.05)
    velocity = on_grid(grid, hill_vortex(points), mask)
    inner = plane_section(grid, mask, [0, 0, 0], [1, 0, 0], [0, 1, 0], radius=0.5**0.5)
    assert plane_flow(velocity, grid, mask, inner) == pytest.approx(3 * np.pi / 8, rel=0.01)
    whole = plane_section(grid, mask, [0, 0, 0], [1, 0, 0], [0, 1, 0])
    assert plane_flow(velocity, grid, mask, whole) == pytest.approx(0, abs=0.06)


def test_volumes_of_a_leaking_valve():
    time = np.linspace(0, 1, 2001)
    flow = np.where(time < 0.5, np.sin(2 * np.pi * time), 0.2 * np.sin(2 * np.pi * time))
    assert stroke_volume(time, flow) == pytest.approx(0.8 / np.pi, rel=1e-5)
    assert regurgitant_volume(time, flow) == pytest.approx(0.2 / np.pi, rel=1e-5)
    assert regurgitant_fraction(time, np.stack([flow, 0 * flow])) == pytest.approx([0.2, 0], rel=1e-5)


def test_e_and_a_between_the_samples():
    def wave(time, at, width):
        return np.exp(-(((time - at) / width) ** 2))

    time = np.arange(0.25, 0.44, 0.005)
    found = e_and_a(time, 3e-5 * wave(time, 0.3017, 0.02) + 2e-5 * wave(time, 0.3931, 0.02))
    assert found.e == pytest.approx(3e-5, rel=2e-3) and found.a == pytest.approx(2e-5, rel=3e-3)
    assert found.e_time == pytest.approx(0.3017, abs=2e-4) and found.a_time == pytest.approx(0.3931, abs=2e-4)
    assert found.ratio == pytest.approx(1.5, rel=5e-3)


def test_one_wave_has_no_a_and_noise_makes_none():
    time = np.linspace(0, 1, 101)
    wave = np.sin(np.pi * time)
    wobble = wave + 0.02 * np.sin(80 * time)
    assert len(peaks(time, wobble)) == 1
    assert np.isnan(e_and_a(time, wobble).ratio)
    with pytest.raises(ValueError, match="no inflow"):
        e_and_a(time, -wave)
