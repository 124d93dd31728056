"""Tracers against rotation, growth and Hill's vortex, and against the walls and openings of a box."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from haemodynamics_cases import ball, hill_vortex, on_grid, order

import geometry
from torchsph.haemodynamics.lagrangian.flow_components import flow_components
from torchsph.haemodynamics.lagrangian.moving_flow import MovingFlow, MovingWalls
from torchsph.haemodynamics.lagrangian.tracers import carry, residence_time, seed_blood


def box_flow(velocity, times, spacing=0.25, **options):
    grid = geometry.Grid((-2.0,) * 3, (spacing,) * 3, (int(4 / spacing) + 1,) * 3)
    points, mask = grid.nodes().numpy(), np.ones(grid.shape, bool)
    frames = np.stack([on_grid(grid, velocity(points, t), mask) for t in times])
    return MovingFlow(grid, times, frames, np.stack([mask] * len(times)), **options)


def test_rotation_is_followed_to_fourth_order_both_ways():
    """Linear in space, so that only the steps are left: after one turn a tracer is back."""
    spin = 2 * np.pi
    flow = box_flow(lambda x, t: np.cross([0, 0, spin], x), [0.0, 1.0])
    start = np.array([[1.0, 0, 0.3], [0, -0.6, 0.1]])
    for end in (1.0, 0.0):
        errors, courants = [], [2.0, 1.0, 0.5]
        for courant in courants:
            found = carry(flow, start, 1.0 - end, end, courant=courant)
            errors.append(float((found.positions - torch.from_numpy(start)).norm(dim=1).max()))
        assert order(courants, errors) > 3.7 and errors[-1] < 1e-4


@pytest.mark.parametrize(("in_time", "least"), [("linear", 1.8), ("cubic", 2.7)])
def test_frames_in_time(in_time, least):
    """u = (cos 3t, sin 3t, 0): what is left is the interpolation between frames."""
    errors, steps = [], [0.1, 0.05, 0.025]
    for step in steps:
        times = np.arange(-2, round(1 / step) + 3) * step
        flow = box_flow(
            lambda x, t: np.tile([np.cos(3 * t), np.sin(3 * t), 0.0], (len(x), 1)), times, 1.0, in_time=in_time
        )
        found = carry(flow, np.zeros((1, 3)), 0.0, 1.0, courant=0.02).positions[0]
        exact = torch.tensor([np.sin(3), 1 - np.cos(3), 0.0]) / 3
        errors.append(float((found - exact).norm()))
    assert order(steps, errors) > least


def test_a_tracer_stays_on_its_stream_surface_in_hills_vortex():
    """psi = 3/4 U r^2 (1 - R^2 / a^2) is constant along a path (Batchelor 1967, sec. 7.2)."""
    errors, spacings = [], [0.2, 0.1, 0.05]
    for spacing in spacings:
        grid, points, mask = ball(spacing)
        frame = on_grid(grid, hill_vortex(points), mask)
        flow = MovingFlow(grid, [0.0, 9.0], np.stack([frame] * 2), np.stack([mask] * 2))
        start = np.array([[0.5, 0.0, 0.1], [0.3, 0.3, -0.2]])
        found = carry(flow, start, 0.0, 4.0, courant=0.3).positions.numpy()

        def stream(x):
            return 0.75 * (x[:, 0] ** 2 + x[:, 1] ** 2) * (1 - (x**2).sum(1))

        errors.append(np.abs(stream(found) / stream(start) - 1).max())
    assert order(spacings, errors) > 1.7 and errors[-1] < 0.02


def test_events_keep_the_two_sides_apart():
    times = np.arange(6) * 1.0
    flow = box_flow(lambda x, t: np.tile([max(t - 2.0, 0.0), 0.0, 0.0], (len(x), 1)), times, 1.0, events=[2.0])
    assert float(flow.field(1.5)[0].max()) == 0.0
    assert float(flow.field(2.5)[0].max()) == pytest.approx(0.5)


def test_a_periodic_flow_goes_on():
    times = np.arange(4) * 0.25
    flow = box_flow(lambda x, t: np.tile([np.sin(2 * np.pi * t), 0, 0], (len(x), 1)), times, 1.0, period=1.0)
    assert torch.equal(flow.field(0.3), flow.field(5.3)) or torch.allclose(flow.field(0.3), flow.field(5.3))
    assert float(carry(flow, np.zeros((1, 3)), 0.0, 3.0, courant=0.1).positions.abs().max()) < 1e-3
    with pytest.raises(ValueError, match="known from"):
        box_flow(lambda x, t: x, times, 1.0).field(2.0)


def upward(box_recording, **options):
    recording = box_recording(
        lambda points, time: np.tile([0.0, 0.0, 0.5], (len(points), 1)),
        times=(0.0, 0.01, 0.02),
        valve_intervals=np.array([[1.0, 0.0, 0.012]]),
    )
    flow = MovingFlow(recording.grid, recording.time, recording.velocity, recording.mask, **options)
    return recording, flow, MovingWalls.from_recording(recording)


def test_open_orifices_let_out_and_walls_turn_back(box_recording):
    _, flow, walls = upward(box_recording)
    start = np.array([[5e-3, 5e-3, 9e-3], [5e-3, 5e-3, 1e-3], [2e-3, 2e-3, 2e-3]])
    up = carry(flow, start, 0.0, 0.02, walls=walls)
    # .5 m/s: the first leaves after 2 ms, the others come to the valve when it is shut
    assert up.left_through.tolist() == [1, 0, 0]
    assert float(up.left_at[0]) == pytest.approx(2e-3, abs=2.1e-3) and torch.isnan(up.left_at[1:]).all()
    assert (up.positions[1:, 2] - 1e-2).abs().max() < 1e-5
    down = carry(flow, start, 0.02, 0.0, walls=walls)
    assert down.left_through.tolist() == [0, 0, 0] and down.positions[:, 2].abs().max() < 1e-5
    stay, whole = residence_time(up, down)
    assert float(stay[1]) == pytest.approx(0.04) and not whole.any()


def test_kept_positions_and_refusals(box_recording):
    _, flow, _ = upward(box_recording)
    found = carry(flow, np.full((1, 3), 2e-3), 0.0, 0.01, keep=[0.004])
    assert found.time.tolist() == [0.0, 0.004, 0.01]
    assert found.paths[:, 0, 2].tolist() == pytest.approx([2e-3, 4e-3, 7e-3])
    with pytest.raises(ValueError, match="times to keep"):
        carry(flow, np.zeros((1, 3)), 0.0, 0.01, keep=[0.5])
    with pytest.raises(ValueError, match="courant"):
        carry(flow, np.zeros((1, 3)), 0.0, 0.01, courant=0.0)


def test_components_of_a_plug(box_recording):
    """Blood moves 4 mm of 10 up in the ejection and down in the filling before: the upper part comes and goes."""

    def plug(points, time):
        return np.tile([0.0, 0.0, 0.4 if time < 0.01005 else -0.4], (len(points), 1))

    recording = box_recording(plug, times=(0.0, 0.01, 0.0101, 0.02, 0.0201), nodes=16)
    frames = np.stack(
        [plug(np.zeros((1, 3)), t)[0][:, None, None, None] + 0 * recording.velocity[0] for t in recording.time]
    )
    flow = MovingFlow(recording.grid, recording.time, frames, recording.mask, in_time="linear")
    walls = MovingWalls.from_recording(recording)
    always = MovingWalls(walls.distance, walls.orifices, np.array([[1.0, -1, 1], [2.0, -1, 1]]))
    seeds = seed_blood(recording.grid, recording.mask[0], 4096, torch.Generator().manual_seed(0))
    found = flow_components(flow, always, seeds, ejection=(0.0, 0.01), filling=(0.0101, 0.02), inlet=1, outlet=1)
    assert found.direct == pytest.approx(0.4, abs=0.03) and found.residual == pytest.approx(0.6, abs=0.03)
    assert found.retained < 0.02 and found.delayed < 0.02
    assert found.direct + found.retained + found.delayed + found.residual == pytest.approx(1)
    with pytest.raises(ValueError, match="run forwards"):
        flow_components(flow, always, seeds, ejection=(0.01, 0.0), filling=(0.0, 0.01))


def test_seeds_fill_the_mask_evenly_and_repeat():
    grid, _, mask = ball(0.25)
    first, again = (seed_blood(grid, mask, 5000, torch.Generator().manual_seed(1)) for _ in range(2))
    assert torch.equal(first, again)
    node = torch.round((first - torch.tensor(grid.origin)) / torch.tensor(grid.spacing)).long()
    counts = np.zeros(grid.shape, int)
    np.add.at(counts, tuple(node.flip(1).T.numpy()), 1)
    assert (counts[~mask] == 0).all() and np.ptp(counts[mask]) <= 1
