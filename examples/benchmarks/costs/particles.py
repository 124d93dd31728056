"""What a particle costs, in seconds of one core a step and in memory, from ten thousand particles to four million.

    python examples/benchmarks/costs/particles.py [--particles N ...] [--steps N] [--threads N] [--json FILE]

A Taylor-Green vortex in a periodic box, default scheme (projection) and weakly compressible, float32, each size in a
process of its own. Of the steps the median counts, the first, which makes room for all that a run holds, apart. Sizes
for which the memory is not there are named and left out.

    us/particle   processor time of a step (of all threads)
    iterations    of the pressure solver, a step
    kB/particle   the largest memory of the process beyond what it had before the scene was made
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import torch

from torchsph import Seeding, preset
from torchsph.methods.memory import free_memory
from torchsph.validation.runs import taylor_green

SIZES = (10_000, 100_000, 1_000_000, 4_000_000)
SCHEMES = ("default", "weakly_compressible")
# bytes that a particle may take before its size is left out
WORST = 5_000
# of a step, in times that the fastest particle needs for its spacing
STEP = 0.4


def measure(count: int, scheme: str, steps: int, threads: int) -> dict[str, float]:
    """One size, in this process."""
    torch.set_num_threads(threads)
    side = round(count ** (1 / 3))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.process_time()
    run = taylor_green(side, 1600.0, dimension=3, scheme=preset(scheme), seeding=Seeding(relaxations=0, packings=0))
    made = time.process_time() - began
    length, each = STEP * run.simulator.scene.spacing, []
    for _ in range(1 + steps):
        taken, began = int(run.record.steps[0]), time.process_time()
        run.advance(run.time + length)
        each.append((time.process_time() - began) / (int(run.record.steps[0]) - taken))
    grown = 1024.0 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    number = side**3
    return {
        "particles": number,
        "made_us": 1e6 * made / number,
        "first_us": 1e6 * each[0] / number,
        "us": 1e6 * statistics.median(each[1:]) / number,
        "iterations": float(run.record.pressure_iterations[0]) / int(run.record.steps[0]),
        "bytes": grown / number,
        "failed": bool(run.record.failed.any()),
    }


def main() -> None:
    """Measure all sizes, each in a child, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, nargs="+", default=SIZES)
    parser.add_argument("--schemes", nargs="+", default=SCHEMES)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(args.particles[0], args.schemes[0], args.steps, args.threads)))
        return
    rows = []
    print("scheme                particles  us/particle  iterations  kB/particle")
    for scheme in args.schemes:
        for count in args.particles:
            free = free_memory()
            if free is not None and WORST * count > free:
                print(
                    f"{scheme:20s} {count:10d}  needs up to {1e-9 * WORST * count:.3g} GB, {1e-9 * free:.3g} are free"
                )
                continue
            given = ["--child", "--particles", str(count), "--schemes", scheme]
            given += ["--steps", str(args.steps), "--threads", str(args.threads)]
            done = subprocess.run([sys.executable, "-W", "ignore", __file__, *given], capture_output=True, text=True)
            if done.returncode:
                print(f"{scheme:20s} {count:10d}  failed: {done.stderr.strip().splitlines()[-1:]}")
                continue
            row = json.loads(done.stdout) | {"scheme": scheme, "threads": args.threads}
            rows.append(row)
            shown = f"{row['us']:12.2f} {row['iterations']:11.1f} {1e-3 * row['bytes']:12.2f}"
            print(f"{scheme:20s} {row['particles']:10d} {shown}", flush=True)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
