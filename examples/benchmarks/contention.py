"""What a busy machine costs: a command on the sample alone, and beside processes that never rest.

    python examples/benchmarks/contention.py [--busy N ...] [--workers N ...] [--threads N ...] [--rounds N]
                                             [--json FILE] [COMMAND ...]

COMMAND: arguments of `torchsph`; by default the splines of the packaged sample. Each round runs every combination once,
so that what else the machine does weighs on all alike, and of the rounds the median counts. Several workers have one
thread each, several threads belong to one worker. Threads that wait for others sleep ("passive", as the command has it
by itself) or spin ("active", the OpenMP library's own way).

    seconds    wall-clock, and of the processor
    over       wall-clock over that of the first row: one worker of one thread
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


def run(command: list[str], workers: int, threads: int, policy: str) -> tuple[float, float]:
    """Seconds of wall-clock and of the processor of one command.

    Raises:
        RuntimeError: it failed.
    """
    environment = os.environ | {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": policy.upper()}
    began, before = time.perf_counter(), os.times()
    done = subprocess.run(
        [sys.executable, "-m", "torchsph", *command, "--workers", str(workers)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
    )
    taken, after = time.perf_counter() - began, os.times()
    if done.returncode:
        raise RuntimeError(f"torchsph {' '.join(command)} ended with {done.returncode}: {done.stderr[-300:]}")
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return taken, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 2])
    cores = len(os.sched_getaffinity(0))
    parser.add_argument("--workers", type=int, nargs="*", default=[cores], help="besides one")
    parser.add_argument("--threads", type=int, nargs="*", default=[cores], help="of one worker, besides one")
    parser.add_argument("--policies", nargs="+", default=["passive", "active"], choices=("passive", "active"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args()
    ways = [(1, 1, "passive"), *((n, 1, "passive") for n in options.workers if n > 1)]
    ways += [(1, n, policy) for n in options.threads if n > 1 for policy in options.policies]
    kinds = [(busy_ones, *way) for busy_ones in options.busy for way in ways]
    times: dict[tuple[int, int, int, str], list[tuple[float, float]]] = {kind: [] for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        sample = ROOT / "torchsph" / "data" / "sample_measured.h5"
        command = options.command or ["smooth", str(sample), "--out", str(Path(folder) / "out.h5"), "--quiet"]
        for _ in range(options.rounds):
            for kind in kinds:
                with busy(kind[0]):
                    times[kind].append(run(command, *kind[1:]))
    rows = []
    for (number, workers, threads, policy), found in times.items():
        wall, used = (statistics.median(column) for column in zip(*found, strict=True))
        row = {"busy": number, "workers": workers, "threads": threads, "waiting": policy}
        rows.append(row | {"seconds": wall, "processor": used})
    alone = rows[0]["seconds"]
    print("busy  workers  threads  waiting   seconds  processor   over")
    for row in rows:
        row["over"] = row["seconds"] / alone
        shown = f"{row['seconds']:9.1f} {row['processor']:10.1f} {row['over']:6.2f}"
        print(f"{row['busy']:4d} {row['workers']:8d} {row['threads']:8d}  {row['waiting']:8s}{shown}")
    if options.json:
        options.json.write_text(json.dumps({"command": command, "load": os.getloadavg(), "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
