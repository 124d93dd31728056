"""What a busy machine costs: a command on the sample alone, and beside processes that never rest.

    python examples/benchmarks/contention.py [--busy N ...] [--threads N ...] [--rounds N] [--json FILE] [COMMAND ...]

COMMAND: arguments of `torchsph`; by default the splines of the packaged sample. Each round runs every combination once,
so that what else the machine does weighs on all alike, and of the rounds the median counts. Threads that wait for
others sleep ("passive", as the command has it by itself) or spin ("active", the OpenMP library's own way).

    seconds    wall-clock, and of the processor
    over       wall-clock over that of one thread with no busy process beside it
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SPIN = "while True: pass"


@contextmanager
def busy(count: int) -> Iterator[list[subprocess.Popen]]:
    """So many processes that use all the time they get, until the end of the block."""
    spinning = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(count)]
    try:
        yield spinning
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def run(command: list[str], threads: int, policy: str) -> tuple[float, float]:
    """Seconds of wall-clock and of the processor of one command.

    Raises:
        RuntimeError: it failed.
    """
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": policy.upper()}
    began, before = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, "-m", "torchsph", *command], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    taken, after = time.perf_counter() - began, os.times()
    if done.returncode:
        raise RuntimeError(f"torchsph {' '.join(command)} ended with {done.returncode}: {done.stderr[-300:]}")
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return taken, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 2])
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, len(os.sched_getaffinity(0))}))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    kinds = [
        (n, t, p) for n in options.busy for t in options.threads for p in ("passive", "active") if t > 1 or p[0] == "p"
    ]
    times: dict[tuple[int, int, str], list[tuple[float, float]]] = {kind: [] for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        sample = ROOT / "torchsph" / "data" / "sample_measured.h5"
        command = options.command or ["smooth", str(sample), "--out", str(Path(folder) / "out.h5"), "--quiet"]
        for _ in range(options.rounds):
            for number, threads, policy in kinds:
                with busy(number):
                    times[number, threads, policy].append(run(command, threads, policy))
    rows = []
    for (number, threads, policy), found in times.items():
        wall, used = (statistics.median(column) for column in zip(*found, strict=True))
        rows.append({"busy": number, "threads": threads, "waiting": policy, "seconds": wall, "processor": used})
    alone = min((row for row in rows if row["threads"] == 1), key=lambda row: row["busy"], default=rows[0])["seconds"]
    print("busy  threads  waiting   seconds  processor   over")
    for row in rows:
        row["over"] = row["seconds"] / alone
        shown = f"{row['seconds']:9.1f} {row['processor']:10.1f} {row['over']:6.2f}"
        print(f"{row['busy']:4d} {row['threads']:8d}  {row['waiting']:8s}{shown}")
    if options.json:
        options.json.write_text(json.dumps({"command": command, "load": os.getloadavg(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
