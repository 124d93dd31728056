"""The recipes of the page run as they stand there."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

import torchsph

PAGE = Path(torchsph.__file__).parent / "cli" / "README.md"
# a command that works until it is told to stop, and then leaves as torchsph does
WORK = """#!/bin/sh
trap 'exit 75' USR1
echo "$@" > told
while :; do sleep 0.02; done
"""


@pytest.mark.skipif(not PAGE.is_file(), reason="the pages are not installed")
@pytest.mark.parametrize("shell", ["sh", "bash"])
def test_a_slurm_job_that_is_told_to_stop_is_queued_again(tmp_path: Path, shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell}")
    text = PAGE.read_text(encoding="utf-8").split("### Slurm")[1]
    (tmp_path / "job.sh").write_text(text.split("```sh\n")[1].split("```")[0])
    for name, content in (("torchsph", WORK), ("scontrol", '#!/bin/sh\necho "$@" > queued\n')):
        (tmp_path / name).write_text(content)
        (tmp_path / name).chmod(0o755)
    path = os.pathsep.join([str(tmp_path), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "SLURM_ARRAY_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3"}
    job = subprocess.Popen([shell, "job.sh"], cwd=tmp_path, env=environment)
    end = time.monotonic() + 20
    while not (tmp_path / "told").is_file() and time.monotonic() < end:
        time.sleep(0.02)
    job.send_signal(signal.SIGUSR1)
    assert job.wait(20) == 75
    assert (tmp_path / "queued").read_text() == "requeue 7_3\n"
    assert (tmp_path / "told").read_text().endswith("recordings.txt --out results --index 3\n")
