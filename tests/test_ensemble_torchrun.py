"""The command line under torchrun: two processes write one result."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import geometry
from torchsph.data import sample_measurement

PACKAGES = Path(geometry.__file__).resolve().parents[1]


def started(folder: Path, *command: str) -> None:
    path = os.pathsep.join([str(PACKAGES), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, cwd=folder, timeout=900,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("method") == 1  # one process prints


@pytest.mark.slow  # a minute
def test_torchrun_writes_what_one_process_writes(tmp_path):
    measured = geometry.read_recording(sample_measurement()).select(slice(11, 14))
    geometry.write_recording(tmp_path / "m.h5", measured)
    given = ("assimilate", "m.h5", "--spacing", "3e-3", "--members", "3", "--resume", "--out")
    started(tmp_path, "torchsph", *given, "one")
    started(tmp_path, "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "torchsph", *given, "two")
    one, two = (geometry.read_recording(tmp_path / name / "analysis.h5") for name in ("one", "two"))
    np.testing.assert_array_equal(one.velocity, two.velocity)
    np.testing.assert_array_equal(one.sigma, two.sigma)
    assert not (tmp_path / "two" / "checkpoint.pt").exists()
