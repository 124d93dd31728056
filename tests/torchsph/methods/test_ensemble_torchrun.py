"""The command line under torchrun: two processes write one result, also where one of them is killed."""

import io
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.distributed as dist

import geometry
from torchsph.data import sample_measurement
from torchsph.methods.runtime.parallel import _round

PACKAGES = Path(geometry.__file__).resolve().parents[1]


GIVEN = ("-m", "torchsph", "assimilate", "m.h5", "--spacing", "3e-3", "--members", "3", "--resume", "--out")
TWO = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


def test_every_start_has_a_name_of_its_own_in_the_store_that_torchrun_keeps():
    """Also where the last start has ended before all had come, and has left what it wrote behind."""
    store, names = dist.HashStore(), []
    store.set("torchsph/hello/1", "gone")
    store.set("torchsph/hello/2", "gone too")
    for _ in range(3):
        with ThreadPoolExecutor(3) as pool:
            rounds = list(pool.map(lambda rank: _round(store, rank, 3), (0, 1, 2)))
        assert len(set(rounds)) == 1
        names += rounds[:1]
    assert len(set(names)) == 3


def launched(folder: Path, *command: str) -> subprocess.Popen:
    path = os.pathsep.join([str(PACKAGES), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
    )


def finished(run: subprocess.Popen) -> None:
    out, err = run.communicate(timeout=900)
    assert run.returncode == 0, err[-2000:]
    assert out.count("method") == 1  # one process prints


def assert_same_analysis(folder: Path, other: Path) -> None:
    one, two = (geometry.read_recording(each / "analysis.h5") for each in (folder, other))
    np.testing.assert_array_equal(one.velocity, two.velocity)
    np.testing.assert_array_equal(one.sigma, two.sigma)
    assert not (other / "checkpoint.pt").exists()


@pytest.mark.slow  # a minute
def test_torchrun_writes_what_one_process_writes(tmp_path):
    measured = geometry.read_recording(sample_measurement()).select(slice(11, 14))
    geometry.write_recording(tmp_path / "m.h5", measured)
    finished(launched(tmp_path, *GIVEN, "one"))
    finished(launched(tmp_path, *TWO, *GIVEN, "two"))
    assert_same_analysis(tmp_path / "one", tmp_path / "two")


def worker_of(agent: int, rank: int) -> int | None:
    """The process of a rank among the children of torchrun's agent; None while there is none."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if parent == agent and f"RANK={rank}" in (entry / "environ").read_text().split("\0"):
                return int(entry.name)
        except (OSError, ValueError):  # it has ended meanwhile
            continue
    return None


def _packed(checkpoint: Path) -> io.BytesIO:
    """What torch packed, after the lines that name, check and identify the file."""
    return io.BytesIO(checkpoint.read_bytes().split(b"\n", 3)[3])


def frames_in(checkpoint: Path) -> int:
    if not checkpoint.exists():
        return 0
    try:
        return len(torch.load(_packed(checkpoint), weights_only=True)["analyses"]["fields"])
    except FileNotFoundError:  # the run has ended and removed it
        return 0


@pytest.mark.slow  # a minute
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="finds the processes of torchrun in /proc")
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_rank_is_restarted_and_goes_on_to_the_same_result(tmp_path, rank):
    measured = geometry.read_recording(sample_measurement()).select(slice(9, 15))
    geometry.write_recording(tmp_path / "m.h5", measured)
    finished(launched(tmp_path, *GIVEN, "whole"))
    run = launched(tmp_path, *TWO, "--max-restarts", "1", *GIVEN, "killed")
    checkpoint, before = tmp_path / "killed" / "checkpoint.pt", 0
    while before < 3:
        assert run.poll() is None, run.communicate()[1][-2000:]
        before = frames_in(checkpoint)
        time.sleep(0.02)
    assert before < measured.frames
    os.kill(worker_of(run.pid, rank), signal.SIGKILL)
    later = []
    while run.poll() is None:
        later.append(frames_in(checkpoint))
        time.sleep(0.1)
    finished(run)
    assert min(held for held in later if held) >= before  # it went on, and did not begin anew
    assert_same_analysis(tmp_path / "whole", tmp_path / "killed")
