"""Workers share a run to the same bits, and neither they nor their end leave anything behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import worker_tasks

import geometry
from torchsph import run_methods
from torchsph.cli import main
from torchsph.data import sample_measurement
from torchsph.methods.memory import MemoryPrediction
from torchsph.methods.runtime import cores
from torchsph.methods.runtime.parallel import _order, _stretch
from torchsph.methods.runtime.workers import KilledWorker, LostWorker, _living, chosen_workers, spread


@pytest.fixture(autouse=True)
def nothing_left(tmp_path_factory, monkeypatch):
    """No process and no file of a run outlives it."""
    folder = tmp_path_factory.mktemp("shared")
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    threads = torch.get_num_threads()
    yield
    assert not _living and not list(folder.glob("torchsph-*")) and torch.get_num_threads() == threads


@pytest.fixture(scope="module", name="measured")
def _measured():
    return geometry.read_recording(sample_measurement()).select(slice(9, 11))


def test_every_task_is_done_once_and_told_to_all_with_its_warnings():
    with pytest.warns(UserWarning, match="task"):
        found = spread(worker_tasks.exchanges, worker_tasks.exchanges, 3)
    assert [number for number, _ in found["tasks"]] == list(range(10))
    assert len({rank for _, rank in found["tasks"]}) > 1  # which of them is for the machine to say
    assert (found["lead"], found["last"], found["anywhere"]) == (0, 2, (False, True))


@pytest.mark.parametrize(("count", "group"), [(10, 3), (3, 2), (2, 5), (0, 2)])
def test_stretches_cover_all_tasks_once_and_everybody_comes_to_all_in_the_end(count, group):
    orders = [_order(count, own, group) for own in range(group)]
    assert all(sorted(order) == list(range(count)) for order in orders)
    assert [k for own in range(group) for k in _stretch(count, own, group)] == list(range(count))
    if count == 10:
        assert orders == [
            [0, 1, 2, 9, 8, 7, 6, 5, 4, 3],
            [3, 4, 5, 2, 1, 0, 9, 8, 7, 6],
            [6, 7, 8, 9, 5, 4, 3, 2, 1, 0],
        ]


@pytest.mark.slow  # a minute
@pytest.mark.parametrize("workers", [2, 3])
def test_any_number_of_processes_makes_the_same_bits(measured, box_recording, workers):
    recording = box_recording(
        lambda points, t: 0.1 * np.cos(100 * points + t), size=0.02, nodes=5, times=(0.0, 0.005, 0.01)
    )
    work = partial(worker_tasks.methods, recording, measured)
    alone, together = spread(work, work, 1), spread(work, work, workers)
    for name in ("splines", "analysis", "sigma", "forecast"):
        np.testing.assert_array_equal(together[name], alone[name], err_msg=name)
    assert together["leads"] == alone["leads"] and together["totals"] == alone["totals"]


@pytest.mark.parametrize(
    ("how", "kind", "words"),
    [
        ("raises", ValueError, "nothing is left"),
        ("SIGKILL", KilledWorker, r"worker 1 of 1 beside .*killed \(SIGKILL\), most likely because memory ran out"),
        pytest.param("SIGSEGV", LostWorker, r"crashed \(SIGSEGV\); try --workers 1", marks=pytest.mark.slow),
    ],
)
def test_a_worker_that_is_lost_ends_the_run_and_says_why(how, kind, words):
    work = partial(worker_tasks.failing, how)
    with pytest.raises(kind, match=words):
        spread(work, work, 2)


@pytest.fixture
def hears_interrupts():
    """A process that a shell has put in the background ignores SIGINT, and pytest with it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("hears_interrupts")
def test_a_request_to_stop_ends_a_wait_for_workers_and_the_workers(tmp_path):
    """The lead waits in an exchange, in compiled code, for a worker that sleeps ten minutes."""
    path = tmp_path / "number"
    work = partial(worker_tasks.waiting, str(path))

    def interrupt() -> None:
        while not (path.exists() and path.read_text()):
            time.sleep(0.02)
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        spread(work, work, 2)
    with pytest.raises(ProcessLookupError):
        os.kill(int(path.read_text()), 0)


def test_the_command_writes_how_many_processes_there_were_and_the_same_file(tmp_path):
    frames = geometry.read_recording(sample_measurement()).select(slice(6, 10))
    geometry.write_recording(tmp_path / "m.h5", frames)
    found = {}
    for workers in (1, 2):
        out = tmp_path / f"{workers}.h5"
        assert (
            main(["smooth", str(tmp_path / "m.h5"), "--out", str(out), "--workers", str(workers), "--no-sidecar"]) == 0
        )
        found[workers] = geometry.read_recording(out)
        account = geometry.read_provenance(out)
        assert account["processes"] == workers and "workers" not in json.dumps(account["settings"])
    np.testing.assert_array_equal(found[1].velocity, found[2].velocity)


@pytest.mark.slow  # a minute
def test_assimilate_writes_the_same_with_workers_and_tells_of_their_memory(tmp_path):
    geometry.write_recording(tmp_path / "m.h5", geometry.read_recording(sample_measurement()).select(slice(9, 12)))
    given = ["assimilate", str(tmp_path / "m.h5"), "--method", "spline,sph,ensemble", "--members", "9", "--no-page"]
    peaks = {}
    for workers in ("1", "2"):
        status = tmp_path / f"{workers}.jsonl"
        more = ["--spacing", "4e-3", "--out", str(tmp_path / workers), "--workers", workers, "--status", str(status)]
        assert main([*given, *more]) == 0
        lines = [json.loads(line) for line in status.read_text().splitlines()]
        assert [line["event"] for line in lines] == ["begun", "frame", "frame", "frame", "done"]
        peaks[workers] = lines[2]["peak"]
        told = json.loads((tmp_path / workers / "metrics.json").read_text())["config"]["info"]["provenance"]
        assert told["processes"] == int(workers)
        assert {path.name for path in (tmp_path / workers).iterdir()} >= {"free.h5", "sph.h5", "quantities.json"}
        assert not list((tmp_path / workers).glob("checkpoint*"))
    assert peaks["2"] > peaks["1"] + (100 << 20)
    for name in ("free", "spline", "sph", "ensemble"):
        one, two = (geometry.read_recording(tmp_path / workers / f"{name}.h5").arrays() for workers in ("1", "2"))
        assert one.keys() == two.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], two[key], err_msg=f"{name} {key}")
    one, two = ((tmp_path / workers / "quantities.csv").read_bytes() for workers in ("1", "2"))
    assert one == two


def test_workers_are_refused_where_there_are_processes_already(measured, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert chosen_workers(None, 8) == 1
    with pytest.raises(ValueError, match="torchrun has started the processes"):
        run_methods(measured, ["spline"], workers=2)


def test_the_number_follows_cores_tasks_and_memory(monkeypatch):
    monkeypatch.setattr("torchsph.methods.runtime.workers.usable_cores", lambda: 6)
    assert chosen_workers(None, 40) == 6 and chosen_workers(None, 3) == 3 and chosen_workers(None, 0) == 1
    assert chosen_workers(9, 3) == 9
    one = MemoryPrediction(splines=10**8, particles=10**8, tables=0, members=0, recordings=0)
    room = one.in_processes(4).total
    assert chosen_workers(None, 40, lambda count: one.in_processes(count).fits(room)) == 4
    with pytest.raises(MemoryError, match=r"in each of 5 processes\), but only .* try fewer --workers"):
        one.in_processes(5).refuse_beyond(room)
    one.in_processes(4).refuse_beyond(room)


def test_cores_are_those_that_this_process_may_use(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda which: set(range(12)), raising=False)
    monkeypatch.setattr(cores, "_quota", lambda: None)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert cores.usable_cores() == 12
    for text, number in (("3", 3), ("4,2", 4), ("0", 12), ("many", 12), ("99", 12)):
        monkeypatch.setenv("OMP_NUM_THREADS", text)
        assert cores.usable_cores() == number
    monkeypatch.undo()
    root, own = tmp_path / "groups", tmp_path / "cgroup"
    (root / "a" / "b").mkdir(parents=True)
    own.write_text("0::/a/b\n")
    assert cores._quota(root, own) is None
    (root / "a" / "b" / "cpu.max").write_text("max 100000\n")
    (root / "a" / "cpu.max").write_text("250000 100000\n")
    assert cores._quota(root, own) == 2.5
    (root / "cpu" / "job").mkdir(parents=True)
    own.write_text("5:cpu,cpuacct:/job\n")
    for name, value in (("cpu.cfs_quota_us", "-1"), ("cpu.cfs_period_us", "100000")):
        (root / "cpu" / "job" / name).write_text(value)
    assert cores._quota(root, own) is None
    (root / "cpu" / "job" / "cpu.cfs_quota_us").write_text("400000")
    assert cores._quota(root, own) == 4.0


@pytest.mark.slow
def test_a_worker_needs_no_guard_in_the_callers_program(tmp_path):
    """No part of `__main__` runs again: a script that calls with workers at its top level ends, once."""
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\n"
        "from torchsph.methods.runtime import parallel\n"
        "from torchsph.methods.runtime.workers import spread\n"
        "print('begun', spread(parallel.rank, parallel.rank, 2))\n"
    )
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout == "begun 0\n"
