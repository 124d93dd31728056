"""Every method on measurements of a known flow, by every measure: the table that the ensemble has to lead.

    python examples/benchmarks/filter_methods.py TRUTH.h5 MEASURED.h5 [--run FOLDER] [--lag 4] [--quick] [--json FILE]

``--run FOLDER`` takes the analysis that `torchsph assimilate` with its defaults has left there instead of making it
again. Seconds are the processor's, those of the splines that "sph" and "ensemble" start from included; for an analysis
of a folder a stretch of ``TIMED`` frames is run again, and its seconds are scaled to all frames.

Rows: the measurement itself ("raw") and its average over time, the simulation without data ("free"), splines frame by
frame and averaged over time (Gaussian of 10 ms, in the frames in which a node lies in the mask), the thesis's particle
filter ("sph"), the ensemble, and the ensemble with later frames improving earlier analyses (``--lag``). All settings
are the command line's own. ``--quick`` takes 100 ms around the fastest flow.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from filter_sweeps import around_the_fastest, averaged

import geometry
from examples.provenance import ANALYSES, write_table
from torchsph.evaluation.metrics import METRICS, evaluate, filled_velocity, spread_over_skill
from torchsph.methods import by_name
from torchsph.methods.by_name import run_methods

SOURCES = ("examples/benchmarks/filter_methods.py", *ANALYSES)
TIMED = 6  # frames


class ProcessorClock:
    """Stands in for the clock that times methods: what other work of the machine takes does not count."""

    perf_counter = staticmethod(time.process_time)


def table(
    measured: geometry.Recording, truth: geometry.Recording, folder: Path | None, lag: int | None, seed: int
) -> dict[str, dict]:
    """One row per method: its measures, seconds and, where it claims an error, the claim over the error."""
    plain = measured.with_velocity(filled_velocity(measured))
    rows = {"raw": (measured, 0.0), "raw over time": (averaged(plain), 0.0)}
    rows |= made(measured, truth, ("spline", "sph") if folder else ("spline", "sph", "ensemble"), seed)
    rows["spline over time"] = (averaged(rows["spline"][0]), 0.0)
    if folder is not None:
        few = measured.select(slice(measured.frames // 2, measured.frames // 2 + TIMED))
        seconds = made(few, truth, ("spline", "ensemble"), seed)["ensemble"][1] * measured.frames / few.frames
        rows["ensemble"] = (geometry.read_recording(folder / "ensemble.h5"), seconds)
    if lag is not None:
        rows[f"ensemble, lag {lag}"] = made(measured, truth, ("spline", "ensemble"), seed, lag=lag)["ensemble"]
    return {name: scored(one, truth, measured) | {"seconds": seconds} for name, (one, seconds) in rows.items()}


def made(
    measured: geometry.Recording, truth: geometry.Recording, methods: tuple[str, ...], seed: int, **more: int
) -> dict[str, tuple[geometry.Recording, float]]:
    """What methods make of a measurement, and the processor seconds of each, splines included."""
    found = run_methods(measured, methods, truth=truth, seed=seed, **more)
    spline = found["spline"].seconds
    first = {"sph": spline, "ensemble": spline}
    return {name: (one.recording, one.seconds + first.get(name, 0.0)) for name, one in found.items()}


def scored(one: geometry.Recording, truth: geometry.Recording, measured: geometry.Recording) -> dict:
    found = {name: score.value for name, score in evaluate(one, truth, measured).items()}
    claim = spread_over_skill(one, truth)
    return found | {"spread_over_skill": None if claim is None else claim.value}


def show(rows: dict[str, dict]) -> None:
    names = (*METRICS, "spread_over_skill", "seconds")
    print(f"{'':18s}" + "".join(f"{name[:12]:>13s}" for name in names))
    for method, row in rows.items():
        print(f"{method:18s}" + "".join(f"{'-' if row[n] is None else format(row[n], '.4g'):>13s}" for n in names))


def main() -> None:
    """Make the table, print it, write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path)
    parser.add_argument("--run", type=Path, help="folder with an ensemble's analysis that is there")
    parser.add_argument("--lag", type=int, help="also run the ensemble with this lag")
    parser.add_argument("--quick", action="store_true", help="a short stretch")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the table here")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    by_name.clock = ProcessorClock
    truth, measured = (geometry.read_recording(file) for file in (options.truth, options.measured))
    if options.quick:
        truth = around_the_fastest(truth)
    first, last = truth.time[[0, -1]]
    measured = measured.select(np.flatnonzero((measured.time > first - 1e-6) & (measured.time < last + 1e-6)))
    rows = table(measured, truth, options.run, options.lag, options.seed)
    show(rows)
    if options.json:
        about = {"measurement": options.measured.name, "threads": options.threads, "seed": options.seed}
        write_table(options.json, about | {"rows": rows}, SOURCES)


if __name__ == "__main__":
    main()
