"""Output files appear whole or not at all, and JSON stays readable by strict readers."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from torchsph.cli.outputs import output_folder, staged, write_json


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
