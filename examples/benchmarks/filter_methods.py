"""Every method on measurements of a known flow, by every measure: the table that the ensemble has to lead.

    python examples/benchmarks/filter_methods.py TRUTH.h5 MEASURED.h5 [MEASURED.h5 ...] [--lag 4] [--quick]
        [--json FILE]

Rows: the measurement itself ("raw") and its average over time, the simulation without data ("free"), splines frame by
frame and averaged over time (Gaussian of 10 ms, in the frames in which a node lies in the mask), the thesis's particle
filter ("sph"), the ensemble, and the ensemble with later frames improving earlier analyses (``--lag``). All settings
are the command line's own. ``--quick`` takes 100 ms around the fastest flow.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from filter_sweeps import around_the_fastest, averaged

import geometry
from torchsph.evaluation.metrics import METRICS, evaluate, filled_velocity, spread_over_skill
from torchsph.methods.by_name import run_methods


def table(measured: geometry.Recording, truth: geometry.Recording, lag: int | None, seed: int) -> dict[str, dict]:
    """One row per method: its measures, seconds and, where it claims an error, the claim over the error."""
    found = run_methods(measured, ("spline", "sph", "ensemble"), truth=truth, seed=seed)
    rows = {name: (result.recording, result.seconds) for name, result in found.items()}
    if lag is not None:
        began = time.perf_counter()
        late = run_methods(measured, ("ensemble",), truth=truth, lag=lag, seed=seed)["ensemble"].recording
        rows[f"ensemble, lag {lag}"] = (late, time.perf_counter() - began)
    plain = measured.with_velocity(filled_velocity(measured))
    rows = {
        "raw": (measured, 0.0),
        "raw over time": (averaged(plain), 0.0),
        "free": rows.pop("free"),
        "spline": rows.pop("spline"),
        "spline over time": (averaged(found["spline"].recording), 0.0),
        **rows,
    }
    return {name: scored(one, truth, measured) | {"seconds": seconds} for name, (one, seconds) in rows.items()}


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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path, nargs="+")
    parser.add_argument("--lag", type=int, help="also run the ensemble with this lag")
    parser.add_argument("--quick", action="store_true", help="a short stretch")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the tables here")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    truth = geometry.read_recording(options.truth)
    if options.quick:
        truth = around_the_fastest(truth)
    tables = {}
    for path in options.measured:
        measured = geometry.read_recording(path)
        first, last = truth.time[[0, -1]]
        measured = measured.select(np.flatnonzero((measured.time > first - 1e-6) & (measured.time < last + 1e-6)))
        tables[path.stem] = table(measured, truth, options.lag, options.seed)
        print(path.stem)
        show(tables[path.stem])
        if options.json:
            about = {"threads": options.threads, "seed": options.seed}
            options.json.write_text(json.dumps(about | {"measurements": tables}, indent=1) + "\n")


if __name__ == "__main__":
    main()
