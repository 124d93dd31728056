"""Many recordings: which there are, how each ends, what is not done twice, and the table of all."""

from __future__ import annotations

import csv
import json
import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import geometry
from torchsph.cli import main
from torchsph.cli.commands import batch
from torchsph.cli.running import child
from torchsph.cli.running.child import Outcome, run_child
from torchsph.cli.running.folder_lock import NAME
from torchsph.cli.running.items import listed
from torchsph.cli.running.stopping import StopSignals
from torchsph.methods.runtime.watching import Stopped

METHOD = ("--method", "spline")


@pytest.fixture(name="recordings")
def _recordings(tmp_path: Path, box_recording: Callable[..., geometry.Recording]) -> Path:
    """Two recordings that can be read, one that is damaged, and a list of them with one that is missing."""
    measured = box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4, times=(0.0, 0.01))
    folder = tmp_path / "in"
    (folder / "b").mkdir(parents=True)
    for name in ("a.h5", "b/a.h5"):
        geometry.write_recording(folder / name, measured)
    (folder / "damaged.h5").write_bytes((folder / "a.h5").read_bytes()[:3000])
    (folder / "all.txt").write_text("# of today\na.h5\n\ngone.h5\ndamaged.h5\nb/a.h5\na.h5\n")
    return folder


def test_lists_patterns_and_files_name_each_recording_once(recordings, tmp_path, monkeypatch):
    items = listed([str(recordings / "all.txt"), str(recordings / "*.h5")], tmp_path / "out")
    assert [item.name for item in items] == ["a", "gone", "damaged", "b/a"]
    assert items[3].folder == tmp_path / "out" / "b" / "a" and items[3].source == recordings / "b" / "a.h5"
    assert [item.name for item in listed([str(recordings / "**" / "a.h5")], "out")] == ["a", "b/a"]
    monkeypatch.chdir(recordings)
    assert [item.name for item in listed(["b/a.h5"], "out")] == ["a"]
    for inputs, told in (["no*.h5"], "no file fits"), (["a.h5", "a.hdf5"], "would share the folder"):
        with pytest.raises(ValueError, match=told):
            listed(inputs, "out")
    with pytest.raises(FileNotFoundError):
        listed(["gone.txt"], "out")


def state_of(root: Path) -> dict[str, str]:
    return {item["item"]: item["state"] for item in json.loads((root / "summary.json").read_text())["items"]}


def test_a_failed_item_costs_itself_alone_and_a_done_one_is_not_done_again(recordings, tmp_path, monkeypatch, capsys):
    root, inputs = tmp_path / "out", ("batch", str(recordings / "all.txt"), "--out", str(tmp_path / "out"), *METHOD)
    ran: list[str] = []

    def run(line: list[str], log: Path, limit: float | None) -> Outcome:
        """The real thing for one item; a crash for another."""
        ran.append(line[1])
        return run_child(line, log, limit) if len(ran) == 1 else Outcome(1, 0.5, "crashed (SIGSEGV)")

    monkeypatch.setattr(batch, "run_child", run)
    assert main(inputs) == 1  # codes 2 and 1
    table = capsys.readouterr().out
    assert "gone.h5: there is no such file" in table and "damaged.h5: file: is not a readable HDF5 file" in table
    assert state_of(root) == {"a": "done", "gone": "failed", "damaged": "failed", "b/a": "failed"}
    assert ran == [str(recordings / "a.h5"), str(recordings / "b" / "a.h5")]
    names = {path.name for path in (root / "a").iterdir()}
    assert {"analysis.h5", "metrics.json", "config.toml", "log.txt", "status.jsonl"} <= names

    ran[:] = ["first"]
    assert main(inputs) == 1 and ran[1:] == [str(recordings / "b" / "a.h5")]
    assert state_of(root)["a"] == "done before"
    ran[:] = ["first"]
    assert main([*inputs, "--index", "3"]) == 1 and main([*inputs, "--index", "0"]) == 0
    assert main([*inputs, "--index", "0", "--seed", "7"]) == 1  # other settings are another result
    assert main([*inputs, "--index", "0", "--again"]) == 1
    assert ran[1:] == [str(recordings / "b" / "a.h5"), *2 * [str(recordings / "a.h5")]]
    assert main([*inputs, "--index", "1"]) == main([*inputs, "--index", "4"]) == 2
    assert "--index: there are 4 recordings, counted from 0; 4 is none of them" in capsys.readouterr().err

    account = geometry.read_provenance(root / "a" / "analysis.h5")
    document = json.loads((root / "a" / "metrics.json").read_text())
    assert account == document["config"]["info"]["provenance"] | {"method": "spline"}
    assert list(account["inputs"]["measurement"]) == [str(recordings / "a.h5")]
    assert geometry.read_provenance(recordings / "a.h5") is None

    assert main(["collect", str(root), "--out", str(tmp_path / "table.csv")]) == 0
    assert "without results: b/a, damaged, gone" in capsys.readouterr().err
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["item"], row["method"], row["state"]) for row in rows] == [
        ("a", "raw", "done"),
        ("a", "spline", "done"),
        ("b/a", "", "unfinished"),
        ("damaged", "", "unfinished"),
        ("gone", "", "unfinished"),
    ]
    spline = document["methods"]["spline"]
    known = {name: value for name, value in spline.items() if value is not None}
    assert known and {name: float(rows[1][name]) for name in known} == pytest.approx(known)
    assert rows[1]["fingerprint"] == account["fingerprint"]


def test_a_killed_item_leaves_no_lock(recordings, tmp_path, monkeypatch):
    folder = tmp_path / "out" / "a"

    def killed(line: list[str], log: Path, limit: float | None) -> Outcome:
        (folder / NAME).write_text(json.dumps({"host": socket.gethostname(), "pid": 1, "started": "today"}))
        return Outcome(3, 1.0, "was killed")

    monkeypatch.setattr(batch, "run_child", killed)
    assert main(["batch", str(recordings / "a.h5"), "--out", str(tmp_path / "out")]) == 3
    assert list(folder.iterdir()) == []


def test_an_interrupted_item_goes_on(recordings, tmp_path, monkeypatch):
    lines: list[list[str]] = []
    monkeypatch.setattr(batch, "run_child", lambda line, log, limit: lines.append(line) or Outcome(75, 1.0, "stopped"))
    arguments = ["batch", str(recordings / "a.h5"), "--out", str(tmp_path / "out"), "--members", "3"]
    assert main(arguments) == 75 and state_of(tmp_path / "out") == {"a": "stopped"}
    (tmp_path / "out" / "a" / "checkpoint.pt").touch()
    assert main(arguments) == 75
    assert ["--resume" in line for line in lines] == [False, True] and "--members=3" in lines[0]


@pytest.mark.parametrize(
    ("program", "limit", "code", "told"),
    [
        ("import os; os.kill(os.getpid(), 11)", None, 1, "crashed (SIGSEGV)"),
        ("import os; os.kill(os.getpid(), 9)", None, 3, "most likely because memory ran out"),
        ("import sys; print('torchsph: error: no'); sys.exit(4)", None, 4, "torchsph: error: no"),
        ("import time; time.sleep(60)", 0.3, 1, "took longer than 0.3 s"),
        ("print('fine')", None, 0, ""),
    ],
)
def test_however_a_child_ends_it_is_told(program, limit, code, told, tmp_path, monkeypatch):
    monkeypatch.setattr(child.sys, "executable", written(tmp_path / "python", program))
    found = run_child([], tmp_path / "log.txt", limit)
    assert found.code == code and told in found.message and bool(told) == bool(found.message)


def written(path: Path, program: str) -> str:
    """A program in the place of the interpreter."""
    path.write_text(f"#!/usr/bin/env -S {os.path.realpath('/proc/self/exe')} -S -E\n{program}\n")
    path.chmod(0o755)
    return str(path)


def test_a_request_to_stop_amid_the_start_of_a_child_does_not_leave_it_behind(tmp_path, monkeypatch):
    started = []

    def popen(*arguments, **options):
        started.append(real(*arguments, **options))
        os.kill(os.getpid(), signal.SIGTERM)
        return started[0]

    real = subprocess.Popen
    monkeypatch.setattr(child.sys, "executable", written(tmp_path / "python", "import time; time.sleep(60)"))
    monkeypatch.setattr(child.subprocess, "Popen", popen)
    with pytest.raises(Stopped), StopSignals():
        run_child([], tmp_path / "log.txt")
    assert started[0].poll() == -signal.SIGTERM


def test_a_request_to_stop_is_handed_on_to_the_child(tmp_path, monkeypatch):
    program = "import signal, sys, time\n"
    program += "signal.signal(signal.SIGTERM, lambda *_: (print('cycle finished', flush=True), sys.exit(75)))\n"
    program += "print('ready', flush=True)\ntime.sleep(60)"
    monkeypatch.setattr(child.sys, "executable", written(tmp_path / "python", program))
    log = tmp_path / "log.txt"

    def ask() -> None:
        while not (log.is_file() and "ready" in log.read_text()):
            pass
        os.kill(os.getpid(), signal.SIGUSR1)

    asking = threading.Thread(target=ask)
    with pytest.raises(Stopped), StopSignals():
        asking.start()
        run_child([], log)
    asking.join()
    assert log.read_text() == "ready\ncycle finished\n"
