"""A checkpoint comes back bit for bit, or is refused with its name and a cure."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchsph
from geometry import Grid, Recording, write_recording
from torchsph import EnsembleOptions
from torchsph.cli import main
from torchsph.methods.ensemble.identity import ensemble_key
from torchsph.methods.measurement.prepared import PreparedMeasurement
from torchsph.methods.runtime import checkpoint
from torchsph.methods.runtime.watching import Stopped

STATE = {"x": torch.arange(500.0), "list": [1, 2.5, None, "text"]}


def load(path: Path, key: str) -> dict[str, Any] | None:
    """The state of a checkpoint as a run of that key gets it."""
    return checkpoint.shared_state(checkpoint.Saved.read(path), key)


@pytest.fixture(name="path")
def _path(tmp_path: Path) -> Path:
    path = tmp_path / "run" / "checkpoint.pt"
    checkpoint.save(path, "key", STATE)
    return path


def test_it_comes_back(path: Path) -> None:
    back = load(path, "key")
    assert torch.equal(back["x"], STATE["x"]) and back["list"] == STATE["list"]
    assert load(path.with_name("none.pt"), "key") is None
    assert os.listdir(path.parent) == ["checkpoint.pt"]


def test_no_flipped_bit_passes(path: Path) -> None:
    good, draw = path.read_bytes(), np.random.default_rng(0)
    places = [*range(150), *draw.integers(0, len(good), 300)]
    for place in places:
        bad = bytearray(good)
        bad[place] ^= 1 << int(draw.integers(8))
        path.write_bytes(bad)
        for look in (lambda: checkpoint.Saved.read(path), lambda: load(path, "key")):
            with pytest.raises(ValueError, match=r"checkpoint.pt: .*remove it and start anew"):
                look()


def test_what_is_cut_or_none_is_refused(path: Path) -> None:
    good = path.read_bytes()
    torch.save([1], path.with_name("other.pt"))
    others = (path.with_name("other.pt").read_bytes(), b"", b"hello", b"\n\n\n\n", good + b"\0")
    for content in (*others, *(good[:length] for length in range(0, len(good), 61))):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"checkpoint.pt: .*remove it and start anew"):
            load(path, "key")
    path.unlink()
    path.mkdir()
    with pytest.raises(FileExistsError, match=r"checkpoint.pt: is a folder"):
        checkpoint.Saved.read(path)


def test_another_run_s_is_refused(path: Path) -> None:
    with pytest.raises(ValueError, match=r"checkpoint.pt: belongs to a run with other"):
        load(path, "other")


def test_a_failed_write_leaves_the_last_state(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for step in ("write", "fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, step, fail)
            with pytest.raises(OSError, match=r"checkpoint.pt"):
                checkpoint.save(path, "key", {"x": torch.zeros(3)})
        assert os.listdir(path.parent) == ["checkpoint.pt"]
        assert torch.equal(load(path, "key")["x"], STATE["x"])


def test_a_planted_link_is_neither_followed_nor_replaced(path: Path) -> None:
    victim = path.with_name("victim")
    victim.write_text("somebody's")
    path.with_name("checkpoint.pt.part").symlink_to(victim)
    checkpoint.save(path, "key", STATE)
    path.unlink()
    path.symlink_to(victim)
    with pytest.raises(FileExistsError, match="symbolic link"):
        checkpoint.save(path, "key", STATE)
    assert victim.read_text() == "somebody's"


def test_the_fingerprint_tells_every_part_and_the_key_every_version_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = ([1.0, "a"], [1.0, "b"], [np.zeros(3)], [np.zeros((3, 1))], [np.zeros(3, np.float32)], ["a", "b"], ["ab"])
    assert len({checkpoint.fingerprint(one) for one in parts}) == len(parts)
    key = checkpoint.run_key({"members": [3]})
    monkeypatch.setattr(torchsph, "__version__", "another")
    assert key != checkpoint.run_key({"members": [3]})


def test_a_refusal_says_what_differs(path: Path) -> None:
    parts = {"measurement": [np.zeros(3)], "members": [3], "seed": [0]}
    checkpoint.save(path, checkpoint.run_key(parts), STATE)
    saved = checkpoint.Saved.read(path)
    saved.refuse_foreign(checkpoint.run_key(parts))
    for others, told in (({"seed": [1]}, "seed"), ({"members": [4], "seed": [1]}, "members, seed")):
        for refuse in (saved.refuse_foreign, saved.state):
            with pytest.raises(ValueError, match=rf"checkpoint.pt: belongs to a run with another {told}; resume with"):
                refuse(checkpoint.run_key(parts | others))


def test_a_resumed_run_reads_it_once(
    path: Path, box_recording: Callable[..., Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refused before any work, and what was read then is what the run goes on from."""
    measured = box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4)
    source, out = tmp_path / "m.h5", tmp_path / "out"
    write_recording(source, measured)

    class Patience:
        def begins(self) -> None: ...
        def frame_done(self, done: object) -> None: ...
        def asked_to_stop(self) -> bool:
            return True

    with pytest.raises(Stopped):
        torchsph.run_methods(
            measured, ("ensemble",), members=2, checkpoints=out / "checkpoint.pt", watcher=Patience(), spacing=3e-3
        )
    reads: list[Path] = []
    read_bytes = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: reads.append(self) or read_bytes(self))
    call = ["assimilate", str(source), "--members", "2", "--spacing", "0.003", "--out", str(out), "--resume", "--quiet"]
    assert main([*call, "--no-quantities", "--no-page"]) == 0
    assert [one.name for one in reads if one.name == "checkpoint.pt"] == ["checkpoint.pt"]
    assert not (out / "checkpoint.pt").exists() and (out / "analysis.h5").exists()


def test_somebody_s_file_of_that_name_is_refused(path: Path) -> None:
    checkpoint.refuse_other_file(path)  # an earlier run's is replaced by a new run
    checkpoint.refuse_other_file(path.with_name("none.pt"))
    path.write_text("hours of work")
    with pytest.raises(ValueError, match=r"checkpoint.pt: is no checkpoint, and would be replaced"):
        checkpoint.refuse_other_file(path)
    path.unlink()
    path.symlink_to(path.with_name("nowhere"))
    for refuse in (checkpoint.refuse_other_file, checkpoint.Saved.read):
        with pytest.raises(FileExistsError, match="symbolic link"):
            refuse(path)


def test_all_that_enters_a_run_enters_its_key(box_recording: Callable[..., Recording]) -> None:
    measured = box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4)
    grid, options = measured.grid, EnsembleOptions()
    model = torchsph.make_model(measured, spacing=3e-3)

    def key(recording: Recording = measured, also=(), with_=model, options=options, members=3, seed=0, **more) -> str:
        prepared = [PreparedMeasurement(one) for one in (recording, *also)]
        return ensemble_key(prepared, with_, model, None, options, members=members, seed=seed, **more)

    recordings = (
        {"grid": Grid(tuple(x + 1e-3 for x in grid.origin), grid.spacing, grid.shape)},
        {"rho": 500.0},
        {"mu": 0.04},
        {"period": 0.02},
        {"velocity": 1.01 * measured.velocity},
    )
    scene = replace(model.scene, gravity=(0.0, 0.0, -9.81))
    others = (
        *({"recording": replace(measured, **change)} for change in recordings),
        {"also": (measured,)},
        {"with_": replace(model, scene=scene)},
        {"options": EnsembleOptions(memory=3.0)},
        {"members": 4},
        {"seed": 1},
        {"truth": measured},
    )
    keys = {key(), *(key(**change) for change in others)}
    assert len(keys) == 1 + len(others) and key(options=EnsembleOptions(minimum_members=2)) in keys
