"""Settings, lists and documents that are no files, or far too deep: told in one line, and nothing is waited for."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from torchsph.cli.main import main
from torchsph.cli.running.small_files import LARGEST, read_small
from torchsph.data import sample_measurement


@pytest.fixture(name="odd", params=["pipe", "device", "folder", "deep", "vast"])
def _odd(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    path = tmp_path / "odd.txt"
    if request.param == "pipe":
        os.mkfifo(path)
    elif request.param == "device":
        path.symlink_to("/dev/zero")
    elif request.param == "folder":
        path.mkdir()
    elif request.param == "deep":
        path.write_text("a = " + "[" * 100_000)
    else:
        with path.open("wb") as file:
            file.truncate(LARGEST + 1)
    return request.param, path


def test_what_is_no_text_file_is_refused_by_its_name(
    odd: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind, path = odd
    sample, out = str(sample_measurement()), str(tmp_path / "out")
    calls = [
        ["info", sample, "--config", str(path)],
        ["convert", sample, "--map", str(path), "--out", out],
        ["report", sample, "--quantities", str(path), "--out", out],
    ]
    if kind != "deep":  # a list of one name that is not there
        calls.append(["batch", str(path), "--out", out])
    if kind in ("pipe", "device"):
        calls.append(["convert", str(path), "--out", out])
    for call in calls:
        assert main(call) == 2
        said = capsys.readouterr().err.splitlines()[-1]
        assert said.startswith("torchsph") and "error: " in said and str(path) in said
    assert not Path(out).exists()


def test_a_folder_whose_document_is_odd_costs_its_row_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("good", "pipe", "deep"):
        (tmp_path / "root" / name).mkdir(parents=True)
    good = {"methods": {"spline": {"error": 0.5}}, "seconds": {}, "config": {}}
    (tmp_path / "root" / "good" / "metrics.json").write_text(json.dumps(good))
    os.mkfifo(tmp_path / "root" / "pipe" / "metrics.json")
    (tmp_path / "root" / "deep" / "metrics.json").write_text("[" * 100_000)
    assert main(["collect", str(tmp_path / "root"), "--out", str(tmp_path / "t.csv")]) == 0
    rows = (tmp_path / "t.csv").read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [["deep", "damaged"], ["good", "done"], ["pipe", "damaged"]]


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xff\n1")
    assert read_small(tmp_path / "a") == b"\xff\n1"
