"""Measurements that say nothing, or claim to be exact, end before any work, with the file, the dataset and a cure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import torchsph as ts
from geometry import Recording, RecordingError, write_recording
from torchsph.cli.main import main
from torchsph.methods.measurement.informative import refuse_exact, refuse_silent


@pytest.fixture(name="measured")
def _measured(box_recording: Callable[..., Recording]) -> Recording:
    recording = box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4)
    return replace(recording, weight=recording.mask.astype(np.float32))


def test_a_recording_without_a_measured_node(measured: Recording) -> None:
    nowhere = np.zeros_like(measured.weight)
    cases = (
        (replace(measured, weight=nowhere), "/weight: is 0 at every node .*; give a positive weight"),
        (replace(measured, weight=None, mask=nowhere), "/mask: holds no node of blood"),
        (replace(measured, weight=None, velocity=np.nan * measured.velocity), "/velocity: is not finite at any node"),
    )
    for silent, words in cases:
        with pytest.raises(RecordingError, match=f"the measurement: {words}"):
            ts.smooth(silent)
    model = ts.make_model(measured, spacing=3e-3)
    for method in (ts.filter_sph, ts.assimilate):
        with pytest.raises(RecordingError, match="the measurement: /weight: is 0 at every node"):
            method(cases[0][0], model)
    one = nowhere.copy()
    one[1, 2, 2, 2] = 1e-3
    refuse_silent(replace(measured, weight=one))


def test_an_error_of_zero_where_something_was_measured(measured: Recording) -> None:
    sigma = np.full_like(measured.velocity, 0.05)
    for value in (0.0, np.inf, np.nan):
        sigma[1, 2, 2, 3, 2] = value
        told = replace(measured, sigma=sigma)
        with pytest.raises(RecordingError, match=r"file.h5: /sigma: must be .* as at frame 1, node \(2, 3, 2\)"):
            refuse_exact(told, "file.h5")
    weight = measured.weight.copy()
    weight[1, 2, 3, 2] = 0.0
    refuse_exact(replace(told, weight=weight))
    refuse_exact(measured)
    for look in (ts.smooth, ts.PreparedMeasurement):
        with pytest.raises(RecordingError, match="the measurement: /sigma: must be positive and finite"):
            look(told)


@pytest.mark.parametrize("command", ["smooth", "assimilate"])
@pytest.mark.parametrize(("dataset", "words"), [("weight", "is 0 at every node"), ("sigma", "is 0 for 1 of")])
def test_commands_name_the_file(
    command: str, dataset: str, words: str, measured: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "silent.h5"
    values = {"weight": np.zeros_like(measured.weight), "sigma": np.full_like(measured.velocity, 0.1)}
    write_recording(path, replace(measured, **{dataset: values[dataset]}))
    if dataset == "sigma":
        with h5py.File(path, "r+") as file:
            file["sigma"][0, 0, 2, 2, 2] = 0.0
    assert main([command, str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert f"torchsph {command}: error: {path}: /{dataset}: {words}" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_frame_without_data_is_forecast(measured: Recording) -> None:
    weight = measured.weight.copy()
    weight[1] = 0.0
    model = ts.make_model(measured, spacing=3e-3)
    found = ts.filter_sph(replace(measured, weight=weight), model, seed=1).recording.velocity
    first = ts.filter_sph(measured.select(slice(0, 2)), model, seed=1).recording.velocity
    assert np.isfinite(found).all() and np.array_equal(found[0], first[0]) and not np.array_equal(found[1], first[1])


def test_recordings_of_another_dimension_than_the_simulator_s(
    measured: Recording, box_recording: Callable[..., Recording]
) -> None:
    plane = box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4, dimension=2)
    space, flat = ts.make_model(measured, spacing=3e-3), ts.make_model(plane, spacing=2e-3)
    calls = (
        lambda: ts.filter_sph(plane, space),
        lambda: ts.filter_sph(measured, flat),
        lambda: ts.assimilate(plane, space, members=2),
        lambda: ts.assimilate(measured, space, members=2, coarse=flat),
        lambda: ts.skill(plane, space, [0.01]),
    )
    for call in calls:
        with pytest.raises(ValueError, match=r"a grid of \d dimensions, .* was given to a simulation of \d"):
            call()
    with pytest.raises(ValueError, match="the truth has a grid of"):
        ts.assimilate(measured, space, members=2, truth=plane)
    for leads, rule in (([-0.01], "leads must not be negative"), ([float("nan")], "leads must be without NaN")):
        with pytest.raises(ValueError, match=rule):
            ts.skill(measured, space, leads)
