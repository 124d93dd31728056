"""Real runs that are interrupted from outside: what was done is kept, and they go on to the same bits."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import geometry
from torchsph.cli.running.folder_lock import NAME
from torchsph.data import sample_measurement

PACKAGES = Path(geometry.__file__).resolve().parents[1]
OPTIONS = ("--members", "2", "--spacing", "4e-3", "--quiet")
FRAMES = 4
STOP = [signal.SIGTERM, signal.SIGUSR1]


def started(folder: Path, *command: str) -> subprocess.Popen[str]:
    """`torchsph` with arguments, in a folder."""
    path = os.pathsep.join([str(PACKAGES), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "torchsph", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
    )


def ended(run: subprocess.Popen[str], code: int) -> str:
    """What a run has said on stderr when it has ended with that code."""
    _, said = run.communicate(timeout=900)
    assert run.returncode == code, said[-2000:]
    return said


def events(status: Path) -> list[dict[str, object]]:
    """What a run has told of itself; a line that is being written does not count."""
    if not status.exists():
        return []
    return [json.loads(line) for line in status.read_text().splitlines(keepends=True) if line.endswith("\n")]


def frames_done(status: Path, run: subprocess.Popen[str], wanted: int) -> None:
    """Wait until a run has done so many frames."""
    while sum(one["event"] == "frame" for one in events(status)) < wanted:
        assert run.poll() is None, run.communicate()[1][-2000:]
        time.sleep(0.01)


def children(parent: int) -> list[int]:
    """The processes that a process has started and that live."""
    return [int(one) for one in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def assert_same(one: Path, other: Path) -> None:
    """Every array of the analyses has the same bits, and nothing but results is left."""
    first, second = (geometry.read_recording(folder / "analysis.h5") for folder in (one, other))
    arrays = first.arrays()
    assert arrays.keys() == second.arrays().keys() and "/quality" in arrays
    for name, array in second.arrays().items():
        np.testing.assert_array_equal(arrays[name], array, err_msg=name)
    left = {path.name for path in other.iterdir()} - {path.name for path in one.iterdir()}
    assert left <= {"log.txt", "status.jsonl"}


@pytest.fixture(scope="module", name="whole")
def _whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a few frames of the sample, m.h5, and an uninterrupted run of them, whole."""
    folder = tmp_path_factory.mktemp("interrupted")
    recording = geometry.read_recording(sample_measurement()).select(slice(8, 8 + FRAMES))
    geometry.write_recording(folder / "m.h5", recording)
    ended(started(folder, "assimilate", "m.h5", *OPTIONS, "--out", "whole"), 0)
    return folder


@pytest.mark.slow  # a minute each
@pytest.mark.parametrize(
    ("number", "workers"),
    [*((number, 1) for number in STOP), (signal.SIGKILL, 1), (signal.SIGTERM, 2), (signal.SIGKILL, 2)],
)
def test_a_run_goes_on_to_the_same_bits(whole: Path, number: signal.Signals, workers: int) -> None:
    name = f"{number.name}_{workers}"
    out, status = whole / name, whole / f"{name}.jsonl"
    call = ("assimilate", "m.h5", *OPTIONS, "--out", name, "--status", status.name)
    run = started(whole, *call, "--workers", str(workers))
    frames_done(status, run, 2)
    beside = children(run.pid)
    assert len(beside) == workers - 1
    run.send_signal(number)
    killed = number == signal.SIGKILL
    said = ended(run, -number if killed else 75)
    assert (out / "checkpoint.pt").exists() and not (out / "analysis.h5").exists()
    if not killed:
        done = sum(one["event"] == "frame" for one in events(status))
        assert f"stopped after frame {done} of {FRAMES}; run it again with --resume to go on" in said
        assert events(status)[-1]["event"] == "stopped" and events(status)[-1]["code"] == 75
        assert not (out / NAME).exists()
    end = time.monotonic() + 30
    while any(Path(f"/proc/{child}").exists() for child in beside):  # they end as their pipe does
        assert time.monotonic() < end
        time.sleep(0.05)
    before = len(events(status))
    ended(started(whole, *call, "--resume"), 0)
    again = [one["frame"] for one in events(status)[before:] if one["event"] == "frame"]
    assert 0 < len(again) <= FRAMES - 2 and again[-1] == FRAMES
    assert_same(whole / "whole", out)


@pytest.mark.slow  # two minutes
def test_a_batch_stops_leaves_the_rest_alone_and_goes_on(whole: Path) -> None:
    for name in ("a", "b"):
        (whole / f"{name}.h5").write_bytes((whole / "m.h5").read_bytes())
    root = whole / "batch"
    call = ("batch", "a.h5", "b.h5", *OPTIONS, "--out", root.name)
    run = started(whole, *call)
    frames_done(root / "a" / "status.jsonl", run, 2)
    run.send_signal(signal.SIGTERM)
    said = ended(run, 75)
    assert "stopped by SIGTERM; run it again to go on" in said
    assert (root / "a" / "checkpoint.pt").exists() and not (root / "a" / NAME).exists()
    assert not (root / "b").exists()
    ended(started(whole, *call), 0)
    for name in ("a", "b"):
        assert_same(whole / "whole", root / name)
    states = {one["item"]: one["state"] for one in json.loads((root / "summary.json").read_text())["items"]}
    assert states == {"a": "done", "b": "done"}
