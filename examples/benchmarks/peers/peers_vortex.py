"""The Taylor-Green vortex in the plane by PySPH's EDAC and delta-SPH and by torchsph, at equal spacing.

    python examples/benchmarks/peers/peers_vortex.py --pysph-python PATH [--quick] [--json FILE] [--resolution N]

Re 100, one decay time, from a lattice and from one whose particles are displaced at random by up to a fifth of a
spacing (torchsph: a tenth to either side). PySPH runs its own example (``taylor_green``, double precision, one thread)
with its own options in the interpreter that is named. Error: relative L2 of the particles' velocities.

Measured at 50^2 with PySPH 1.0b2 (results/peers_vortex.json; lattice, uneven): torchsph 0.9 and 0.5 % in 1.2 CPU
seconds, EDAC 3.7 and 1.5 % in 36, delta-SPH 67 and 19 % in 50 (nothing keeps its particles even). At 16^2 (--quick)
EDAC is as good: 5.4 and 6.4 % against 5.4 and 7.0 %.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import torch

from examples.provenance import MODEL, write_table
from torchsph import Seeding
from torchsph.validation import exact_flows as validation
from torchsph.validation.runs import taylor_green, taylor_green_error

SOURCES = ("examples/benchmarks/peers/peers_vortex.py", *MODEL)

DECAY_TIME = 100 / (8 * math.pi**2)
SCHEMES = {"EDAC": ["--scheme", "edac"], "delta-SPH": ["--scheme", "wcsph", "--delta-sph"]}
# run by PySPH's interpreter; the last two lines: seconds as [wall, CPU], and the particles as [t, x, y, u, v]
DRIVER = """
import json, sys, time
from pysph.examples.taylor_green import TaylorGreen
clock = []
class Timed(TaylorGreen):
    def pre_step(self, solver):
        if not clock:
            clock.extend([time.perf_counter(), time.process_time()])
example = Timed(fname="taylor_green")
example.run(sys.argv[1:])
print(json.dumps([time.perf_counter() - clock[0], time.process_time() - clock[1]]))
fluid = example.particles[0]
print(json.dumps([example.solver.t, *(list(map(float, c)) for c in (fluid.x, fluid.y, fluid.u, fluid.v))]))
"""


def ours(resolution: int, uneven: bool) -> dict:
    """One run of torchsph with the options for periodic flows."""
    run = taylor_green(resolution, seeding=Seeding(jitter=0.1 if uneven else 0.0))
    cpu, wall = time.process_time(), time.perf_counter()
    run.advance(DECAY_TIME)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {"code": "torchsph", "uneven": uneven, "error": taylor_green_error(run), "cpu_s": cpu, "wall_s": wall}


def theirs(python: str, scheme: str, resolution: int, uneven: bool) -> dict:
    """One run of PySPH's example; seconds from its first step on, without set-up and compilation."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            python,
            "-c",
            DRIVER,
            "--nx",
            str(resolution),
            "--re",
            "100",
            "--tf",
            str(DECAY_TIME),
            "--no-openmp",
            "--disable-output",
            "-d",
            folder,
            "--perturb",
            "0.2" if uneven else "0",
            *SCHEMES[scheme],
        ]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        text = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    (wall, cpu), (end, *columns) = (json.loads(line) for line in text.splitlines()[-2:])
    x, y, u, v = torch.tensor(columns, dtype=torch.float64)
    exact = validation.taylor_green_2d(torch.stack([x, y], 1), end, 0.01)
    error = float((torch.stack([u, v], 1) - exact).norm() / exact.norm())
    return {"code": f"PySPH {scheme}", "uneven": uneven, "error": error, "cpu_s": cpu, "wall_s": wall}


def main() -> None:
    """Run both codes, print a table, write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pysph-python", metavar="PATH", help="interpreter that has PySPH; without it torchsph alone")
    parser.add_argument("--quick", action="store_true", help="16^2 particles instead of --resolution")
    parser.add_argument("--resolution", type=int, default=50, help="particles along each side (default 50)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    resolution = 16 if options.quick else options.resolution
    rows = []
    for uneven in (False, True):
        rows.append(ours(resolution, uneven))
        if options.pysph_python:
            rows += [theirs(options.pysph_python, scheme, resolution, uneven) for scheme in SCHEMES]
    print(f"{'code':<18} {'start':<9} {'error':>8} {'CPU s':>7} {'wall s':>7}")
    for row in rows:
        start = "uneven" if row["uneven"] else "lattice"
        print(f"{row['code']:<18} {start:<9} {row['error']:>8.4f} {row['cpu_s']:>7.1f} {row['wall_s']:>7.1f}")
    if options.json:
        report = {"rows": rows, "resolution": resolution, "load": os.getloadavg()[0]}
        write_table(options.json, report, SOURCES)


if __name__ == "__main__":
    main()
