"""One and two workers on the same assimilation: wall-clock, CPU seconds, and what bounds the gain.

    python examples/benchmarks/costs/ranks.py [--quick] [--json FILE] [--members N ...] [--frames N] [--repeats N]

Runs `torchsph assimilate`'s ensemble (with its splines and its run without data) on the sample, with one worker and
with two in turn, and compares the analyses bit for bit. Of the repeats the fastest counts.

    wall      s from the start of the second worker to the end, without the start of the first (`launch`)
    CPU       s of each process
    bound     what the ratio of the walls would be on cores that nobody else uses: the CPU seconds of one process over
              those of the critical path of two, where from one exchange to the next the slower one counts
    repeated  share of one process's seconds that both processes spend
    sent      MB that the first process tells the other for a frame
"""

import argparse
import hashlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import torch.distributed as dist

import geometry
from torchsph.data import sample_measurement
from torchsph.methods import by_name as pipeline
from torchsph.methods.runtime import parallel
from torchsph.methods.runtime.workers import spread

EXCHANGES = ("all_gather", "all_gather_object", "broadcast", "broadcast_object_list", "barrier")


class Segments:
    """CPU seconds of this process from one exchange with the others to the next, and the bytes that it tells them."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.sent, packed = 0, parallel._packed

        def counted(value):
            found = packed(value)
            self.sent += len(found)
            return found

        parallel._packed = counted
        self.began, self.inside = time.process_time(), False
        for name in EXCHANGES:
            setattr(dist, name, self._counting(getattr(dist, name)))

    def close(self) -> None:
        self.seconds.append(time.process_time() - self.began)

    def _counting(self, exchange):
        def counted(*given, **named):
            if self.inside:  # some exchanges are made of others
                return exchange(*given, **named)
            self.close()
            self.inside = True
            try:
                return exchange(*given, **named)
            finally:
                self.inside, self.began = False, time.process_time()

        return counted


def work(members: int, frames: int) -> dict:
    """One process's part: what the first one returns counts."""
    segments = Segments()
    measured = geometry.read_recording(sample_measurement())
    measured = measured.select(slice(measured.frames - frames, measured.frames))
    run = pipeline.run_methods(measured, ["ensemble"], members=members)["ensemble"].recording
    segments.close()
    everyone, sent = [segments.seconds], 0
    if dist.is_initialized():
        sent, everyone = segments.sent, [None] * dist.get_world_size()
        dist.all_gather_object(everyone, segments.seconds)
    digest = hashlib.sha256(run.velocity.tobytes() + run.sigma.tobytes()).hexdigest()
    return {"segments": everyone, "digest": digest, "sent": sent / frames}


def launched(processes: int, members: int, frames: int) -> dict:
    """A run with so many workers, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        out, began = Path(folder) / "out.json", time.perf_counter()
        given = ["--child", str(processes), str(out), "--members", str(members), "--frames", str(frames)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        subprocess.run([sys.executable, __file__, *given], check=True, env=environment, capture_output=True)
        found = json.loads(out.read_text())
    parts = found.pop("segments")
    found["launch"] = time.perf_counter() - began - found["wall"]
    found["cpu"] = [sum(part) for part in parts]
    found["critical"] = sum(max(each) for each in zip(*parts, strict=True))
    return found


def compared(members: int, frames: int, repeats: int) -> dict:
    """The fastest of several runs with one process and with two."""
    runs = {1: [], 2: []}
    for _ in range(repeats):
        for processes, found in runs.items():
            found.append(launched(processes, members, frames))
    one, two = (min(found, key=lambda run: run["wall"]) for found in runs.values())
    alone = min(run["cpu"][0] for run in runs[1])
    critical = min(run["critical"] for run in runs[2])
    spent = min(sum(run["cpu"]) for run in runs[2])
    same = len({run["digest"] for found in runs.values() for run in found}) == 1
    return {
        "members": members,
        "frames": frames,
        "wall": [one["wall"], two["wall"]],
        "ratio": one["wall"] / two["wall"],
        "cpu": alone,
        "cpu_of_two": two["cpu"],
        "critical": critical,
        "bound": alone / critical,
        "repeated": spent / alone - 1.0,
        "sent": two["sent"],
        "launch": [one["launch"], two["launch"]],
        "same_bits": same,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="five frames, 16 members, one run of each")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--members", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        # by the name under which the other process finds it as well
        part = partial(importlib.import_module(Path(__file__).stem).work, args.members[0], args.frames)
        began = time.perf_counter()
        found = spread(part, part, int(args.child[0]))
        Path(args.child[1]).write_text(json.dumps(found | {"wall": time.perf_counter() - began}))
        return
    if args.quick:
        args.members, args.frames, args.repeats = [16], 5, 1
    rows = []
    print("members    one s    two s    ratio   CPU of one   of two            bound  repeated  sent  same bits")
    for members in args.members:
        row = compared(members, args.frames, args.repeats)
        rows.append(row)
        one, two = row["wall"]
        each = " + ".join(f"{seconds:.1f}" for seconds in row["cpu_of_two"])
        same = "yes" if row["same_bits"] else "NO"
        print(
            f"{members:7d} {one:8.1f} {two:8.1f} {row['ratio']:8.2f} {row['cpu']:12.1f}   {each:15s} "
            f"{row['bound']:7.2f} {100 * row['repeated']:7.0f} % {1e-6 * row['sent']:5.2f}  {same}",
            flush=True,
        )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
