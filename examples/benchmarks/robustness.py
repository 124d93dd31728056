"""Splines and ensemble on measurements whose walls, valves, frames or sector are wrong: error beside a Gaussian's.

    python examples/benchmarks/robustness.py TRUTH.h5 MEASURED.h5 [--case NAME ...] [--frames 22 36] [--seed 0]
        [--json FILE]

One row per case of ``damage.CASES``: NRMSE over the truth's mask of the measurement, of the weighted Gaussian (3 mm
full width at half maximum), of splines and of the ensemble, all settings the command line's own; ratios beside them.
The results file is updated case by case, so that a run can be resumed or done in parts; a whole beat is an hour, frames
from --frames on (the damage is done to the whole recording) minutes.
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
from damage import CASES
from spline_phantom import gaussian

import geometry
from examples.provenance import ANALYSES, write_table
from torchsph.evaluation.metrics import evaluate, filled_velocity, spread_over_skill
from torchsph.methods.by_name import run_methods

SOURCES = ("examples/benchmarks/robustness.py", "examples/benchmarks/damage.py", *ANALYSES)

METHODS = ("spline", "ensemble")


def smoothed(measured: geometry.Recording) -> geometry.Recording:
    """The weighted Gaussian of every frame."""
    weight = np.where(np.isfinite(measured.velocity).all(1), measured.weight, 0.0) * measured.mask
    pairs = zip(measured.velocity, weight, strict=True)
    fields = [gaussian(velocity, own, measured.grid.spacing) for velocity, own in pairs]
    return measured.with_velocity(np.stack(fields) * measured.mask[:, None])


def row(measured: geometry.Recording, truth: geometry.Recording, methods: tuple[str, ...], seed: int) -> dict:
    """Errors of one case, the ensemble's spread over its error, and seconds."""
    began = time.perf_counter()
    found = run_methods(measured, methods, truth=truth, seed=seed)
    results = {"raw": measured.with_velocity(filled_velocity(measured)), "gaussian": smoothed(measured)}
    results |= {name: found[name].recording for name in methods}
    errors: dict = {name: evaluate(one, truth, measured)["nrmse"].value for name, one in results.items()}
    if "ensemble" in results:
        claim = spread_over_skill(results["ensemble"], truth)
        errors["spread_over_skill"] = None if claim is None else claim.value
    return errors | {"seconds": time.perf_counter() - began}


def show(rows: dict[str, dict]) -> None:
    """Print the table."""
    print(
        f"{'case':30s}{'raw':>8s}{'Gauss':>8s}{'spline':>8s}{'ensemble':>9s}{'s/G':>7s}{'e/s':>7s}{'e/G':>7s}{'spread':>8s}"
    )
    for case, found in rows.items():
        raw, blurred, spline = (found[name] for name in ("raw", "gaussian", "spline"))
        ensemble = found.get("ensemble", float("nan"))
        spread = found.get("spread_over_skill") or float("nan")
        print(
            f"{case:30s}{raw:8.3f}{blurred:8.3f}{spline:8.3f}{ensemble:9.3f}{spline / blurred:7.2f}"
            f"{ensemble / spline:7.2f}{ensemble / blurred:7.2f}{spread:8.2f}",
            flush=True,
        )


def main() -> None:
    """Run the cases asked for, beside those already in the results file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path)
    parser.add_argument("--case", action="append", choices=CASES, help="these alone (repeat)")
    parser.add_argument("--only", choices=METHODS, help="one of the methods alone")
    parser.add_argument("--frames", type=int, nargs=2, metavar=("FIRST", "STOP"), help="of the measurement (all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="results file, read and updated")
    options = parser.parse_args()
    torch.set_num_threads(1)
    truth = geometry.read_recording(options.truth)
    known = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    rows = known.get("cases", {})
    for case in options.case or CASES:
        measured = geometry.read_recording(options.measured)
        damaged = CASES[case](measured, np.random.default_rng(options.seed))
        if options.frames:
            damaged = damaged.select(slice(*options.frames))
        methods = METHODS if options.only is None else (options.only,)
        rows[case] = rows.get(case, {}) | row(damaged, truth, methods, options.seed)
        show({case: rows[case]})
        if options.json:
            about = {"measurement": options.measured.name, "frames": options.frames, "seed": options.seed}
            write_table(options.json, about | {"cases": rows}, SOURCES)
    show(rows)


if __name__ == "__main__":
    main()
