"""Valve times from the walls' volume and the flow beside the openings; what cannot be is mended."""

from dataclasses import replace

import numpy as np
import pytest

import geometry
from geometry.motion.valve_times import find_valve_times

TIME = np.linspace(0.0, 0.8, 81)
# s: emptying and filling, at rest between
EMPTYING, FILLING = (0.1, 0.35), (0.45, 0.7)


def rate_at(time):
    """dV/dt over the volume, 1/s: two half sines."""
    out = np.zeros_like(time)
    for (start, stop), sign in ((EMPTYING, -1.0), (FILLING, 1.0)):
        inside = (time > start) & (time < stop)
        out[inside] += sign * np.sin(np.pi * (time[inside] - start) / (stop - start))
    return 1.2 * out


def box_with_openings(regions, velocity=None, intervals=None, noise=0.0):
    """A box of 20 mm whose height changes; openings `regions` (quarters of the lid), `velocity(label, time)`."""
    box = geometry.box((0, 0, 0), (0.02, 0.02, 0.02), 0.0025)
    fine = np.linspace(0, 0.8, 8001)
    height = 1 + np.concatenate([[0], np.cumsum(0.5 * (rate_at(fine[1:]) + rate_at(fine[:-1])) * np.diff(fine))])
    height = np.interp(TIME, fine, height)
    vertices = np.repeat(box.vertices[None], len(TIME), 0)
    vertices[:, :, 2] *= height[:, None]
    lid = box.normals[:, 2] > 0.5
    quarter = (box.centroids[:, 0] > 0.01).astype(int) + 2 * (box.centroids[:, 1] > 0.01)
    region = np.zeros(len(box.faces), np.uint8)
    for place, label in enumerate(regions):
        region[lid & (quarter == place)] = label
    generator = np.random.default_rng(0)
    vertices = vertices * (1 + noise * generator.standard_normal((len(TIME), 1, 1)))
    grid = geometry.Grid((0.001,) * 3, (0.002,) * 3, (16, 10, 10))
    points = grid.nodes().numpy()
    side = (points[:, 0] > 0.01).astype(int) + 2 * (points[:, 1] > 0.01)
    lid = 0.02 * np.gradient(height, TIME)  # blood at a shut opening goes with it
    field = np.zeros((len(TIME), 3, grid.size), np.float32)
    for place, label in enumerate(regions):
        for frame, time in enumerate(TIME):
            field[frame, 2, side == place] = lid[frame] + (0.0 if velocity is None else velocity(label, time))
    mask = np.stack([(points[:, 2] < 0.02 * h).reshape(grid.shape) for h in height])
    wall = geometry.Wall(vertices, box.faces, region)
    shape = (len(TIME), 3, *grid.shape)
    given = None if intervals is None else np.array(intervals, float)
    return geometry.Recording(TIME, grid, field.reshape(shape), mask, wall, 1060.0, 4e-3, valve_intervals=given)


@pytest.mark.parametrize(("noise", "within"), [(0.0, 0.006), (0.003, 0.04)])
def test_inlet_and_outlet_are_open_in_their_phases(noise, within):
    found = find_valve_times(box_with_openings((1, 2), noise=noise))
    assert found.source == "found" and len(found.changes) == 2
    np.testing.assert_allclose(found.intervals, [[1, *FILLING], [2, *EMPTYING]], atol=within)
    assert (np.abs(found.intervals[:, 1:] - [FILLING, EMPTYING]) <= found.error + 0.012).all()


def test_the_only_opening_serves_both():
    found = find_valve_times(box_with_openings((7,)))
    np.testing.assert_allclose(found.intervals, [[7, *EMPTYING], [7, *FILLING]], atol=0.006)


def test_the_flow_tells_which_of_many_openings_take_part():
    """3 and 5 let in, 4 lets out and leaks in filling, 6 stays shut."""

    def velocity(label, time):
        inwards = -rate_at(np.array([time]))[0] * 0.1
        filling = inwards < 0
        return {3: inwards * filling, 5: inwards * filling, 4: inwards * (0.3 if filling else 1.0), 6: 0.0}[label]

    found = find_valve_times(box_with_openings((3, 4, 5, 6), velocity))
    times = {(int(label), opens < 0.4) for label, opens, _ in found.intervals}
    assert times == {(3, False), (5, False), (4, True), (4, False)}


def test_times_that_cannot_be_are_corrected_and_named():
    late = box_with_openings((1, 2), intervals=[(1, 0.5, 0.75), (2, 0.15, 0.4)])
    found = find_valve_times(late)
    assert found.source == "corrected"
    np.testing.assert_allclose(found.intervals, [[1, 0.45, 0.75], [2, 0.1, 0.4]], atol=0.006)
    assert "opening 2 opens at 0.09" in found.changes[0] and "not at 0.15 s" in found.changes[0]
    assert found.applied(late).valve_intervals is found.intervals


@pytest.mark.parametrize("early", [0.0, 0.02])
def test_times_that_can_be_stand(early):
    """Open before or after anything flows contradicts nothing."""
    rows = [(1, 0.45 - early, 0.7 + early), (2, 0.1 - early, 0.35 + early)]
    recording = box_with_openings((1, 2), intervals=rows)
    found = find_valve_times(recording)
    assert found.source == "given" and found.applied(recording) is recording


def test_a_valve_that_is_said_to_stay_shut_is_left_shut():
    found = find_valve_times(box_with_openings((1, 2), intervals=[(2, 0.1, 0.35)]))
    assert found.source == "given"


def test_openings_of_a_rigid_wall_are_always_open():
    recording = box_with_openings((1, 2))
    rigid = replace(recording, wall=replace(recording.wall, vertices=recording.wall.vertices[0]))
    found = find_valve_times(rigid)
    assert found.intervals[:, 0].tolist() == [1, 2]
    assert (found.intervals[:, 1] <= TIME[0]).all() and (found.intervals[:, 2] >= TIME[-1]).all()
    assert "keep their volume" in found.changes[0]


def test_a_wall_without_openings_has_no_times():
    found = find_valve_times(box_with_openings(()))
    assert found.intervals.shape == (0, 3) and found.source == "given"


def test_a_rigid_cavity_with_one_opening_passes_nothing():
    recording = box_with_openings((1,))
    rigid = replace(recording, wall=replace(recording.wall, vertices=recording.wall.vertices[0]))
    assert len(find_valve_times(rigid).intervals) == 0


def test_both_estimates_together():
    exact = box_with_openings((1, 2), intervals=[(1, 0.44, 0.71), (2, 0.09, 0.36)])
    found = geometry.estimated(exact)
    assert found.recording is exact and found.warnings == () and found.summary() == {}
    flickering = geometry.estimated(box_with_openings((1, 2), noise=0.003))
    assert len(flickering.warnings) == 3 and "jitters by" in flickering.warnings[0]
    assert set(flickering.summary()) == {"wall", "valves"}
