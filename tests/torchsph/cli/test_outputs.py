"""Output files appear whole or not at all, and JSON stays readable by strict readers."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from torchsph.cli.main import main
from torchsph.cli.outputs import output_folder, staged, write_analysis, write_json
from torchsph.cli.terminal import printable
from torchsph.data import sample_measurement
from torchsph.simulator.failures import NumericalFailure


def test_staged_files_arrive_together(tmp_path):
    with staged(tmp_path / "a" / "b") as scratch:
        (scratch / "one").write_text("1")
        (scratch / "two").write_text("2")
        assert not (tmp_path / "a" / "b" / "one").exists()
    assert {path.name: path.read_text() for path in (tmp_path / "a" / "b").iterdir()} == {
        "one": "1",
        "two": "2",
    }


def test_staged_files_vanish_on_failure_and_others_stay(tmp_path):
    (tmp_path / "one").write_text("older")
    with pytest.raises(RuntimeError), staged(tmp_path) as scratch:
        (scratch / "one").write_text("newer")
        raise RuntimeError
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("one", "older")]
    with pytest.raises(RuntimeError), staged(tmp_path / "new"):
        raise RuntimeError
    assert not (tmp_path / "new").exists()


def test_the_scratch_folder_of_a_killed_run_is_swept_and_a_living_one_s_is_not(tmp_path):
    program = "import os, sys\nfrom torchsph.cli.outputs import staged\n"
    program += "with staged(sys.argv[1]) as scratch:\n    (scratch / 'one').touch()\n    os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], cwd=tmp_path).returncode == -signal.SIGKILL
    (dead,) = tmp_path.iterdir()
    (tmp_path / ".torchsph-link").symlink_to(tmp_path)
    with staged(tmp_path) as first, staged(tmp_path) as second:
        assert first.exists() and second.exists() and not dead.exists()
    assert [path.name for path in tmp_path.iterdir()] == [".torchsph-link"]


def test_staged_files_take_the_place_of_no_link(tmp_path):
    (tmp_path / "target").write_text("somebody's")
    (tmp_path / "two").symlink_to(tmp_path / "target")
    with pytest.raises(FileExistsError, match="two: is a symbolic link"), staged(tmp_path) as scratch:
        (scratch / "one").write_text("1")
        (scratch / "two").write_text("2")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["target", "two"]
    assert (tmp_path / "target").read_text() == "somebody's"


def test_text_of_files_reaches_the_terminal_in_one_plain_line():
    assert printable("Müller, 心臓 \u00b5m") == "Müller, 心臓 \u00b5m"
    assert printable("x\nrecording valid\x1b[2J\x07\u202e\udcfc") == r"x\nrecording valid\x1b[2J\x07\u202e\udcfc"
    assert len(printable("x" * 60000)) < 2100


def test_an_interruption_during_the_imports_is_130(monkeypatch, capsys):
    class Interrupted:
        def find_spec(self, name, *_):
            if name == "torchsph.cli.program":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "torchsph.cli.program", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    assert main(["info", "--backends"]) == 130
    assert capsys.readouterr().err == "torchsph: error: interrupted\n"


def test_a_closed_stdout_is_no_fault(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    assert main(["info", "--backends"]) == 0


def test_output_folder_refuses_what_cannot_hold_files(tmp_path):
    (tmp_path / "file").write_text("")
    assert output_folder(tmp_path / "not" / "yet") == tmp_path / "not" / "yet"
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match="is a file"):
            output_folder(path)


def test_json_is_strict_and_plain(tmp_path):
    content = {
        "nan": float("nan"),
        "inf": np.float32(np.inf),
        "array": np.arange(3),
        "tuple": (1, True, None, "text"),
        "device": torch.device("cpu"),
        5: np.float64(0.5),
    }
    write_json(tmp_path / "a.json", content)
    text = (tmp_path / "a.json").read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert json.loads(text) == {
        "nan": None,
        "inf": None,
        "array": [0, 1, 2],
        "tuple": [1, True, None, "text"],
        "device": "cpu",
        "5": 0.5,
    }


def test_a_result_that_is_no_flow_is_a_numerical_fault_not_one_of_units(tmp_path):
    good = geometry.read_recording(sample_measurement()).select(slice(0, 2))
    runaway = replace(good, velocity=1e3 * good.velocity)
    for sidecar in (False, True):
        with pytest.raises(
            NumericalFailure, match=r"what was computed is no flow: its /velocity reaches [\d.]+, above"
        ) as told:
            write_analysis(tmp_path / "a.h5", runaway, {}, sidecar=sidecar)
        assert "convert" not in str(told.value) and "mm/s" not in str(told.value)
    assert not list(tmp_path.iterdir())
