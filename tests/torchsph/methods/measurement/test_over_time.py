"""Splines averaged over time: less noise where frames agree, no change of a flow lost, the walls' flow as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import geometry
from torchsph import PreparedMeasurement, average_over_time, smooth
from torchsph.cli import main
from torchsph.data import sample_measurement, sample_truth
from torchsph.evaluation.metrics import evaluate
from torchsph.methods.measurement.frame_splines import FrameSmoother
from torchsph.methods.measurement.wall_balance import WallBalance

TIMES = np.arange(12) * 1e-2


def still(points, t):
    away = points - 0.5 * points.max(0, keepdims=True)
    out = np.zeros_like(points)
    out[:, 0], out[:, 1] = -away[:, 1], away[:, 0]
    return out / np.abs(out).max()


def cell(points, t):
    """A vortex at rest at the walls of its box, without divergence."""
    x, y = (np.pi * points[:, :2] / points[:, :2].max(0)).T
    return np.stack([np.sin(x) ** 2 * np.sin(2 * y), -np.sin(2 * x) * np.sin(y) ** 2], 1)


def swinging(points, t):
    """Turns over within two frames."""
    return still(points, t) * np.cos(np.pi * t / 2e-2)


class Frames(FrameSmoother):
    """Knows which frames measured something, and no more."""

    def __init__(self, recording):
        self.recording = recording


def noisy(recording, deviation=0.2, seed=0):
    drawn = np.random.default_rng(seed).normal(0, deviation, recording.velocity.shape) * recording.mask[:, None]
    return recording.with_velocity(recording.velocity + drawn.astype(np.float32))


def error(found, true):
    mask = np.broadcast_to(np.asarray(true.mask, bool)[:, None], true.velocity.shape)
    return np.sqrt(((found.velocity - true.velocity)[mask] ** 2).mean())


def test_noise_falls_with_the_number_of_frames_in_the_mean(box_recording):
    """Independent noise s in n equal shares leaves s / sqrt(n): here the sum of the squared weights."""
    true = box_recording(still, nodes=8, times=TIMES)
    seen = noisy(true)
    found, width = average_over_time(seen, Frames(seen), 2e-2)
    weights = np.exp(-0.5 * ((TIMES[:, None] - TIMES) / 2e-2) ** 2)
    weights[np.abs(TIMES[:, None] - TIMES) > 6e-2 + 1e-9] = 0
    share = np.sqrt(((weights / weights.sum(1, keepdims=True)) ** 2).sum(1).mean())
    assert width == 2e-2 and error(found, true) == pytest.approx(0.2 * share, rel=0.05)
    assert "averaged over 20 ms" in found.description


def test_the_frames_choose_wide_for_noise_and_narrow_for_change(box_recording):
    wide = noisy(box_recording(still, nodes=8, times=TIMES))
    narrow = noisy(box_recording(swinging, nodes=8, times=TIMES), 0.02)
    (_, still_width), (found, moving_width) = (average_over_time(one, Frames(one)) for one in (wide, narrow))
    assert still_width > 3e-2 and moving_width < 4e-3
    assert error(found, narrow) < 0.06  # next to nothing is taken from a flow that changes
    # a double of the clock is a double of the width
    slow = replace(wide, time=2 * wide.time)
    assert average_over_time(slow, Frames(slow)).width == pytest.approx(2 * still_width, rel=1e-6)


def test_frames_without_data_are_filled_and_few_frames_stay(box_recording):
    seen = noisy(box_recording(still, nodes=8, times=TIMES))
    weight = np.ones(seen.mask.shape, np.float32)
    weight[5] = 0
    empty = replace(
        seen, weight=weight, velocity=np.where(np.arange(12)[:, None, None, None, None] == 5, 0, seen.velocity)
    )
    found = average_over_time(empty, Frames(empty)).recording
    true = box_recording(still, nodes=8, times=TIMES)
    mask = np.asarray(true.mask[5], bool)
    assert np.abs(found.velocity[5][:, mask] - true.velocity[5][:, mask]).std() < 0.1
    assert found.uncovered.sum() == 0
    two = seen.select(slice(0, 2))
    assert average_over_time(two, Frames(two)) == (two, 0.0)
    assert average_over_time(seen, Frames(seen), 0.0).recording is seen
    for wrong in (-1.0, float("nan")):
        with pytest.raises(ValueError, match="width must be"):
            average_over_time(seen, Frames(seen), wrong)


def test_a_beat_goes_round(box_recording):
    seen = replace(noisy(box_recording(still, nodes=8, times=TIMES)), period=0.12)
    found = average_over_time(seen, Frames(seen), 1e-2).recording.velocity
    rolled = replace(seen, velocity=np.roll(seen.velocity, 3, 0))
    again = average_over_time(rolled, Frames(rolled), 1e-2).recording.velocity
    np.testing.assert_allclose(again, np.roll(found, 3, 0), atol=1e-6)


def test_what_the_walls_drive_keeps_its_timing():
    filling = geometry.Ventricle().recording(np.linspace(0.25, 0.31, 7), grid_spacing=2e-3, wall_spacing=2e-3)
    balance = WallBalance(filling, geometry.WallMotion.from_recording(filling))
    known = filling.with_velocity(np.stack([balance.known(frame) for frame in range(filling.frames)]))
    kept = average_over_time(known, Frames(known), 2e-2, balance).recording
    np.testing.assert_allclose(kept.velocity, known.velocity, atol=1e-6)
    assert error(average_over_time(known, Frames(known), 2e-2).recording, known) > 0.005


def test_the_command_line_averages_when_it_is_asked(box_recording, tmp_path, capsys):
    source, out = tmp_path / "plane.h5", tmp_path / "smooth.h5"
    true = box_recording(cell, dimension=2, nodes=10, times=TIMES[:5])
    geometry.write_recording(source, noisy(true))
    written = {}
    for asked in ([], ["--over-time", "auto"], ["--over-time", "0.01"]):
        assert main(["smooth", str(source), "--out", str(out), "--workers", "1", *asked]) == 0
        written[" ".join(asked)] = error(geometry.read_recording(out), true)
        told = capsys.readouterr()
        assert ("averaged over time by a Gaussian of" in told.out + told.err) == bool(asked)
    assert max(written["--over-time auto"], written["--over-time 0.01"]) < 0.9 * written[""]
    for wrong in ("-1", "nan", "wide"):
        with pytest.raises(SystemExit):
            main(["smooth", str(source), "--out", str(out), "--over-time", wrong])


@pytest.mark.slow
def test_the_sample_is_smoothed_better_over_time(tmp_path):
    """By the command line as by Python, and by the frames' own choice."""
    measured = geometry.read_recording(sample_measurement()).select(slice(4, 12))
    source, out = tmp_path / "measured.h5", tmp_path / "smooth.h5"
    geometry.write_recording(source, measured)
    assert main(["smooth", str(source), "--out", str(out), "--over-time", "auto", "--workers", "1"]) == 0
    truth = geometry.read_recording(sample_truth())
    found = geometry.read_recording(out)
    alone = smooth(measured)
    over, plain = (evaluate(one, truth)["nrmse"].value for one in (found, alone))
    assert over < 0.97 * plain
    prepared = PreparedMeasurement(measured)
    again = average_over_time(alone, prepared.splines, None, prepared.balance).recording
    np.testing.assert_array_equal(again.velocity, found.velocity)
