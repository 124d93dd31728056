"""Scatterers: order of the integrator, a density that stays uniform, fully developed speckle, tissue."""

import math

import numpy as np
import pytest
import torch
from ultrasound_cases import packet, recording, uniform, vortex

from torchsph.ultrasound.scanner.flow import LinearFlow, RecordingFlow, refined
from torchsph.ultrasound.scanner.scatterers import Box, Cloud, advance, carry, reseed, seed_cloud

BOX = Box((-4e-3, -4e-3, -4e-3), (4e-3, 4e-3, 4e-3))
DENSITY = 2e10


def test_rotation_is_followed_with_fourth_order():
    rate = 300.0
    flow = LinearFlow((0.0, 0.0, 0.0), ((0, -rate, 0), (rate, 0, 0), (0, 0, 0)))
    start = torch.tensor([[2e-3, 0.0, 1e-3]], dtype=torch.float64)
    duration, errors = 4e-3, []
    angle = rate * duration
    exact = torch.tensor([[2e-3 * math.cos(angle), 2e-3 * math.sin(angle), 1e-3]], dtype=torch.float64)
    for steps in (4, 8, 16):
        place = start
        for number in range(steps):
            place = advance(place, flow, number * duration / steps, duration / steps)
        errors.append(float((place - exact).norm()))
    order = np.polyfit(np.log([4, 8, 16]), np.log(errors), 1)[0]
    assert order == pytest.approx(-4, abs=0.25)


def test_inflow_keeps_a_uniform_cloud_uniform_and_disturbs_nothing_inside():
    generator = torch.Generator().manual_seed(0)
    flow = LinearFlow((0.8, 0.0, -0.4))
    cloud = seed_cloud(BOX, flow, 0.0, DENSITY, generator)
    first = cloud
    for step in range(20):  # 4 mm: half the box is new
        cloud = carry(cloud, BOX, flow, step * 2.5e-4, 2.5e-4, DENSITY, generator)
        cloud = reseed(cloud, BOX, flow, 0.0, DENSITY, generator)
    mean = DENSITY * BOX.volume
    assert len(cloud.position) == pytest.approx(mean, abs=5 * math.sqrt(mean))
    for axis in range(3):
        counts = torch.histc(cloud.position[:, axis], 8, -4e-3, 4e-3)
        assert float(((counts - mean / 8) ** 2 / (mean / 8)).sum()) < 30  # chi-square, 7 degrees: 1e-4
    stayed = BOX.contains(first.position + torch.tensor([4e-3, 0.0, -2e-3]))
    assert set(first.amplitude[stayed].tolist()) <= set(cloud.amplitude.tolist())


def test_thinned_cells_are_refilled_and_crowded_ones_thinned():
    generator = torch.Generator().manual_seed(1)
    flow = LinearFlow((0.0, 0.0, 0.0))
    cloud = seed_cloud(BOX, flow, 0.0, DENSITY, generator)
    hole = cloud.position.norm(dim=1) < 2.5e-3
    kept = Cloud(*(part[~hole] for part in (cloud.position, cloud.amplitude, cloud.tissue)))
    doubled = Cloud(
        *(
            torch.cat([part, part[:0], part[cloud.position[:, 0] > 3e-3]])
            for part in (cloud.position, cloud.amplitude, cloud.tissue)
        )
    )
    mean = DENSITY * BOX.volume
    for broken in (kept, doubled):
        assert abs(len(broken.position) - mean) > 0.05 * mean
        mended = reseed(broken, BOX, flow, 0.0, DENSITY, generator)
        assert len(mended.position) == pytest.approx(mean, rel=0.03)
    assert reseed(cloud, BOX, flow, 0.0, DENSITY, generator).position.shape == cloud.position.shape


def test_speckle_is_fully_developed():
    """Intensity is exponential: mean over deviation of the magnitude is 1.91 (Burckhardt 1978)."""
    images = [packet((0.0, 0.0, 0.0), seed, snr=None, tissue=None).iq[0].flatten() for seed in range(6)]
    magnitude = torch.cat(images).abs()
    assert float(magnitude.mean() / magnitude.std()) == pytest.approx(1.913, abs=0.1)
    assert float(magnitude.square().mean()) == pytest.approx(1, abs=0.15)


def test_recording_flow_is_the_recording_at_its_nodes_and_frames():
    true = recording(vortex, frames=3)
    flow = RecordingFlow(true, dtype=torch.float64)
    nodes = true.grid.nodes()[torch.from_numpy(true.mask[1].reshape(-1))]
    found = flow.velocity(nodes, float(true.time[1]))
    np.testing.assert_allclose(found.T.numpy(), true.velocity[1][:, true.mask[1]], atol=1e-7)
    assert flow.blood(nodes, 0.0).all()
    assert not flow.blood(torch.tensor([[0.0, 0.0, 14e-3]], dtype=torch.float64), 0.0).any()


def test_tissue_takes_the_velocity_of_the_nearest_wall():
    true = recording(uniform, frames=2)
    moving = np.zeros((2, *true.wall.vertices.shape), np.float32)
    moving[..., 2] = 0.05
    from dataclasses import replace

    true = replace(true, wall=replace(true.wall, velocity=moving))
    flow = RecordingFlow(true)
    assert flow.velocity(torch.tensor([[0.0, 0.0, 15e-3]]), 0.0)[0, 2] == pytest.approx(0.05)


def test_boxes_and_densities_are_checked():
    with pytest.raises(ValueError, match="lower < upper"):
        Box((0.0, 0.0), (1.0, 0.0))
    with pytest.raises(ValueError, match="density"):
        seed_cloud(BOX, LinearFlow((0.0,) * 3), 0.0, 0.0, torch.Generator())


def test_a_field_is_refined_as_quadratics_are():
    """And the nodes keep their values, whatever the field."""
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (5, 6, 7)), indexing="ij")
    fine = torch.meshgrid(*(torch.arange(3 * n - 2, dtype=torch.float64) / 3 for n in (5, 6, 7)), indexing="ij")
    found = refined((z * z - 2 * y * x + 3 * x)[None], 3)
    true = fine[0] ** 2 - 2 * fine[1] * fine[2] + 3 * fine[2]
    inner = (slice(3, -3),) * 3
    torch.testing.assert_close(found[0][inner], true[inner], rtol=0, atol=1e-12)
    rough = torch.rand((2, 4, 5), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(refined(rough, 3)[:, ::3, ::3], rough)
