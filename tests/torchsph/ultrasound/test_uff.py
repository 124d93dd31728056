"""UFF volumes: a round trip through pyuff_ustb, pixels in any order, and what is refused."""

import numpy as np
import pytest
import torch
from ultrasound_cases import cube, packet

from geometry import Grid
from torchsph.ultrasound import IQPhase, SpeckleTracker, TrackingPlan, read_uff_recording
from torchsph.ultrasound.acquisition import Beams
from torchsph.ultrasound.uff import UffVolumes, read_uff, regular_grid, write_uff

GRID = Grid((-1e-3, 2e-3, 20e-3), (0.5e-3, 0.4e-3, 0.3e-3), (4, 3, 5))


def test_pixels_in_any_order_find_their_grid():
    pixels = GRID.nodes().numpy()
    shuffled = np.random.default_rng(0).permutation(len(pixels))
    grid, order = regular_grid(pixels[shuffled], "test")
    assert grid.shape == GRID.shape
    np.testing.assert_allclose(grid.origin, GRID.origin)
    np.testing.assert_allclose(grid.spacing, GRID.spacing)
    np.testing.assert_allclose(pixels[shuffled][order], pixels)


def test_pixels_that_make_no_regular_grid_are_refused():
    pixels = GRID.nodes().numpy()
    with pytest.raises(ValueError, match="do not fill"):
        regular_grid(pixels[:-1], "test")
    bent = pixels.copy()
    bent[:, 0] **= 2
    with pytest.raises(ValueError, match="evenly"):
        regular_grid(bent, "test")


def test_round_trip_of_iq_and_velocity(tmp_path):
    pytest.importorskip("pyuff_ustb")
    scene = packet((0.1, 0.0, 0.2), 0, grid=cube(3))
    volumes = UffVolumes(scene.iq[:, None].numpy(), scene.grid, 4000.0, 5e6)
    write_uff(tmp_path / "a.uff", volumes, "iq")
    back = read_uff(tmp_path / "a.uff", "iq").packet(Beams())
    torch.testing.assert_close(back.iq.to(torch.complex64), scene.iq)
    assert back.acquisition == scene.acquisition
    np.testing.assert_allclose(back.grid.origin, scene.grid.origin)
    plane = Grid((0.0, 10e-3), (1e-3, 2e-3), (4, 6))
    velocity = np.random.default_rng(1).normal(size=(3, 2, *plane.shape)).astype(np.float32)
    write_uff(tmp_path / "a.uff", UffVolumes(velocity, plane), "velocity")
    found = read_uff(tmp_path / "a.uff", "velocity")
    np.testing.assert_array_equal(found.values, velocity)
    assert found.grid.shape == plane.shape and found.frame_rate is None
    with pytest.raises(ValueError, match="no IQ"):
        found.packet(Beams((0.0, 1.0)))
    with pytest.raises(ValueError, match="nothing"):
        read_uff(tmp_path / "a.uff", "nothing")
    with pytest.raises(ValueError, match="whole frame rates"):
        write_uff(tmp_path / "b.uff", UffVolumes(velocity, plane, 0.5))


def test_a_missing_file_and_a_packet_without_rates(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.uff"):
        read_uff(tmp_path / "none.uff")
    with pytest.raises(ValueError, match="frame_rate"):
        UffVolumes(np.zeros((2, 1, *GRID.shape), np.complex64), GRID).packet(Beams())


def test_iq_of_a_file_becomes_a_recording_whatever_its_phase(tmp_path):
    """As USTB leaves it, the carrier is still in: the packet is in baseband, and the flow is what it was."""
    pytest.importorskip("pyuff_ustb")
    plane = Grid((-3e-3, 21e-3), (1e-4, 1e-4), (61, 61))
    scene = packet((0.1, 0.2), 0, grid=plane, beams=Beams((0.0, 1.0)), tissue=None)
    depth = plane.nodes()[:, 1].reshape(plane.shape)
    carrier = torch.polar(torch.ones_like(depth), scene.acquisition.phase_per_metre * depth).to(scene.iq)
    write_uff(tmp_path / "iq.uff", UffVolumes((scene.iq * carrier)[:, None].numpy(), plane, 4000.0, 5e6), "iq")
    found = read_uff(tmp_path / "iq.uff", "iq").packet(Beams((0.0, 1.0)))
    assert found.phase is IQPhase.BASEBAND
    torch.testing.assert_close(found.iq, scene.iq, atol=1e-4, rtol=1e-4)
    plan = TrackingPlan(spacing=1e-3, images=8, tracker=SpeckleTracker(clutter=None))
    recording = read_uff_recording(tmp_path / "iq.uff", "iq", plan=plan)
    assert recording.frames == 2 and recording.wall is None
    np.testing.assert_allclose(recording.time, [3.5 / 4000, 11.5 / 4000])
    assert recording.grid.shape == (7, 7) and recording.grid.spacing == pytest.approx((1e-3, 1e-3))
    inner = recording.weight[:, 2:-2, 2:-2] > 0
    assert inner.mean() > 0.9
    mean = np.moveaxis(recording.velocity[..., 2:-2, 2:-2], 1, -1)[inner].mean(axis=0)
    np.testing.assert_allclose(mean, [0.1, 0.2], atol=0.01)


def test_velocities_of_a_file_become_a_recording(tmp_path):
    pytest.importorskip("pyuff_ustb")
    velocity = np.random.default_rng(1).normal(scale=0.1, size=(3, 3, *GRID.shape)).astype(np.float32)
    velocity[1, 0, 0, 0, 0] = np.nan
    write_uff(tmp_path / "v.uff", UffVolumes(velocity, GRID, 50.0), "velocity")
    recording = read_uff_recording(tmp_path / "v.uff", "velocity")
    np.testing.assert_allclose(recording.time, [0, 0.02, 0.04])
    np.testing.assert_array_equal(recording.velocity[0], velocity[0])
    assert recording.weight.sum() == recording.weight.size - 1 and recording.weight[1, 0, 0, 0] == 0
    write_uff(tmp_path / "one.uff", UffVolumes(velocity[:, :1], GRID, 50.0), "speed")
    with pytest.raises(ValueError, match="1 channels of real values"):
        read_uff_recording(tmp_path / "one.uff", "speed")
    write_uff(tmp_path / "still.uff", UffVolumes(velocity, GRID), "velocity")
    with pytest.raises(ValueError, match="no frame_rate"):
        read_uff_recording(tmp_path / "still.uff", "velocity")
