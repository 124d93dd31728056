"""`torchsph quantify`: what it writes and prints, and what it refuses."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import geometry
from torchsph.cli.main import main


def plug(points, time):
    return np.tile([0.0, 0.0, -(0.5 + 20 * time)], (len(points), 1))


def test_table_json_and_csv(tmp_path, capsys, box_recording):
    truth = box_recording(plug)
    half = truth.with_velocity(0.5 * truth.velocity, sigma=np.full_like(truth.velocity, 0.1))
    geometry.write_recording(tmp_path / "truth.h5", truth)
    geometry.write_recording(tmp_path / "half.h5", half)
    command = ["quantify", str(tmp_path / "half.h5"), "--truth", str(tmp_path / "truth.h5"), "--out", str(tmp_path)]
    assert main(command) == 0
    document = json.loads((tmp_path / "quantities.json").read_text(encoding="utf-8"))
    found = document["curves"]["analysis"]["kinetic_energy"]
    speed = 0.5 * (0.5 + 20 * truth.time)
    np.testing.assert_allclose(found, 0.5 * 1060 * (speed**2 + 0.03) * 1e-6, rtol=1e-4)
    assert document["beat"]["truth"]["a_time"] is None
    with (tmp_path / "quantities.csv").open(encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert len(rows) == 4 and "truth pressure_difference [Pa]" in rows[0]
    table = capsys.readouterr().out
    assert "flow_inlet (RMS)" in table and "0.500" in table and "wall shear stress" in table


@pytest.mark.parametrize("cut", [True, False])
def test_a_plane_is_told_per_metre_of_depth(tmp_path, capsys, box_recording, cut):
    plane = box_recording(
        lambda points, time: np.tile([0.0, -(0.5 + 20 * time)], (len(points), 1)), dimension=2, cut=cut
    )
    geometry.write_recording(tmp_path / "plane.h5", plane)
    assert (
        main(["quantify", str(tmp_path / "plane.h5"), "--truth", str(tmp_path / "plane.h5"), "--out", str(tmp_path)])
        == 0
    )
    document = json.loads((tmp_path / "quantities.json").read_text(encoding="utf-8"))
    found = document["curves"]["analysis"]
    np.testing.assert_allclose(found["kinetic_energy"], 0.5 * 1060 * (0.5 + 20 * plane.time) ** 2 * 1e-4, rtol=1e-6)
    assert document["units"]["kinetic_energy"] == "J/m" and document["units"]["flow_inlet"] == "m2/s"
    assert ("pressure_difference" in found) != cut
    table = capsys.readouterr().out
    assert "per metre of depth" in table and ("third of its difference" in table) == cut


def test_faults_are_one_line(tmp_path, capsys, box_recording):
    for name, cut in (("flow", False), ("cut", True)):
        plane = box_recording(lambda points, time: 0 * points, dimension=2, cut=cut)
        geometry.write_recording(tmp_path / f"{name}.h5", plane)
    command = ["quantify", str(tmp_path / "flow.h5"), "--truth", str(tmp_path / "cut.h5"), "--out", str(tmp_path)]
    assert main(command) == 2
    told = capsys.readouterr().err
    assert "cut plane" in told and len(told.strip().splitlines()) == 1
    assert not (tmp_path / "quantities.json").exists()


def test_nodes_without_a_value_are_told(tmp_path, capsys, box_recording):
    whole = box_recording(plug)
    weight = np.array(whole.mask, np.float32)
    weight[:, : weight.shape[1] // 2] = 0
    for name, recording in (("whole", whole), ("half", replace(whole, weight=weight))):
        geometry.write_recording(tmp_path / f"{name}.h5", recording)
        assert main(["quantify", str(tmp_path / f"{name}.h5"), "--out", str(tmp_path)]) == 0
        told = capsys.readouterr().err
        assert ("of the nodes in the blood carry no value and count as at rest" in told) == (name == "half")
