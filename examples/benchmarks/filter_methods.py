"""Every method on measurements of a known flow, by every measure: the table that the ensemble has to lead.

    python examples/benchmarks/filter_methods.py TRUTH.h5 MEASURED.h5 [--run FOLDER] [--lag 4] [--quick] [--json FILE]

``--run FOLDER`` takes the analyses of "free", "spline" and "ensemble" that `torchsph assimilate` with its defaults has
left there instead of making them again. Seconds are the processor's, those of the splines that "sph" and "ensemble"
start from included; for analyses of a folder a stretch of ``TIMED`` frames is run again, and its seconds are scaled.

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
from torchsph.methods import methods_run
from torchsph.methods.by_name import run_methods
from torchsph.methods.measurement.prepared import PreparedMeasurement
from torchsph.methods.models import ANALYSIS_SPACING, make_model
from torchsph.methods.nudging import filter_sph

SOURCES = ("examples/benchmarks/filter_methods.py", *ANALYSES)
TIMED = 6  # frames


class ProcessorClock:
    """Stands in for the clock that times methods: what other work of the machine takes does not count."""

    perf_counter = staticmethod(time.process_time)


Rows = dict[str, tuple[geometry.Recording, float]]


def table(
    measured: geometry.Recording, truth: geometry.Recording, folder: Path | None, lag: int | None, seed: int
) -> dict[str, dict]:
    """One row per method: its measures, seconds and, where it claims an error, the claim over the error."""
    plain = measured.with_velocity(filled_velocity(measured))
    rows = {"raw": (measured, 0.0), "raw over time": (averaged(plain), 0.0)}
    if folder is None:
        rows |= made(measured, truth, ("spline", "sph", "ensemble"), seed)
    else:
        rows |= left(measured, truth, folder, seed)
    rows["spline over time"] = (averaged(rows["spline"][0]), 0.0)
    if lag is not None:
        rows[f"ensemble, lag {lag}"] = made(measured, truth, ("spline", "ensemble"), seed, lag=lag)["ensemble"]
    return {name: scored(one, truth, measured) | {"seconds": seconds} for name, (one, seconds) in rows.items()}


def made(
    measured: geometry.Recording, truth: geometry.Recording, methods: tuple[str, ...], seed: int, **more: int
) -> Rows:
    """What methods make of a measurement, and the processor seconds of each, splines included."""
    found = run_methods(measured, methods, truth=truth, seed=seed, **more)
    first = {"sph": found["spline"].seconds, "ensemble": found["spline"].seconds}
    return {name: (one.recording, one.seconds + first.get(name, 0.0)) for name, one in found.items()}


def left(measured: geometry.Recording, truth: geometry.Recording, folder: Path, seed: int) -> Rows:
    """What a folder holds, the thesis's filter run from its splines, and seconds of a stretch scaled to all frames."""
    few = measured.select(slice(measured.frames // 2, measured.frames // 2 + TIMED))
    share = measured.frames / few.frames
    seconds = {name: share * own for name, (_, own) in made(few, truth, ("spline", "ensemble"), seed).items()}
    rows = {
        name: (geometry.read_recording(folder / f"{name}.h5"), seconds[name]) for name in ("free", "spline", "ensemble")
    }
    began = time.process_time()
    prepared = PreparedMeasurement(measured, smoothed=rows["spline"][0])
    model = make_model(measured, spacing=ANALYSIS_SPACING * min(measured.grid.spacing))
    run = filter_sph(prepared, model, seed=seed)
    return rows | {"sph": (run.recording, seconds["spline"] + time.process_time() - began)}


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
    methods_run.clock = ProcessorClock
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
