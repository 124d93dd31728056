"""Tune rivals, judge them, print the table; see the package's text."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import geometry
from torchsph.evaluation.metrics import evaluate, filled_velocity
from torchsph.haemodynamics import FlowDomain
from torchsph.methods.by_name import run_methods
from torchsph.methods.measurement.over_time import average_over_time
from torchsph.methods.measurement.prepared import PreparedMeasurement

from ..provenance import ANALYSES, ROOT, provenance
from . import __doc__ as about
from . import tuning
from .cases import CASES, Case
from .registry import RIVALS, Rival
from .scores import read_out, scores

TABLE = ROOT / "examples" / "rivals" / "results" / "rivals.json"
METHODS = ROOT / "examples" / "benchmarks" / "results"
SOURCES = ("examples/rivals/methods", "examples/rivals/frames.py", "examples/rivals/scores.py")
OWN = ("spline", "spline over time", "ensemble")
NAMES = {
    "nrmse": "error",
    "direction_error_deg": "direction, °",
    "divergence_rms": "divergence, 1/s",
    "energy_loss": "energy loss / true",
    "pressure_difference": "error of the pressure difference",
    "seconds": "seconds",
}
DIGITS = {
    "nrmse": 3,
    "direction_error_deg": 1,
    "divergence_rms": 2,
    "energy_loss": 2,
    "pressure_difference": 2,
    "seconds": 1,
}
PAGE = """# Rivals on the same measurements

Written by `python -m examples.rivals`; all numbers and settings stand in `rivals.json` below `results/`. Every rival is
our own small implementation of somebody's idea, its settings chosen on a ventricle of another shape, beat and seed
(`tuning.py`), never on what it is judged by. Errors are RMS errors over the RMS speed; energy loss and pressure
difference are those of `torchsph.haemodynamics`; seconds are CPU seconds of one thread, of a network that is trained on
other flows without its training. **spline** and **ensemble** are torchsph's own methods, with their defaults; **spline
over time** is `torchsph smooth --over-time auto`.
"""
OVER_TIME = " over time"
COLUMNS = ("nrmse", "direction_error_deg", "divergence_rms", "energy_loss", "pressure_difference", "seconds")


def load(file: Path) -> dict[str, Any]:
    """The table as far as it went."""
    empty: dict[str, Any] = {"settings": {}, "rows": {}}
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else empty


def store(file: Path, table: dict[str, Any]) -> None:
    """Write the table whole."""
    part = file.with_suffix(".part")
    part.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    part.replace(file)


def tuned(rival: Rival, noise: str, true: geometry.Recording) -> dict[str, Any]:
    """The settings of the least error on the tuning ventricle, and that error."""
    measured = tuning.measurement(true, noise)
    tried = []
    for settings in tqdm(rival.combinations(), desc=f"tune, {noise}", disable=None):
        found = measured.with_velocity(rival.fit(measured, **rival.fixed, **settings))
        tried.append((float(evaluate(found, true)["nrmse"].value or np.inf), settings))
    error, settings = min(tried, key=lambda each: each[0])
    return {"settings": settings, "nrmse_when_tuned": error, "combinations": len(tried)}


def judged(
    rival: Rival, settings: dict[str, Any], measured: geometry.Recording, judge: Callable[[np.ndarray], dict[str, Any]]
) -> dict[str, Any]:
    """A row of the table, with settings that have never seen the measurement."""
    if rival.learns:
        rival.fit(measured.select(slice(0, 1)), **rival.fixed, **settings)
    began = time.process_time()
    velocity = rival.fit(measured, **rival.fixed, **settings)
    seconds = time.process_time() - began
    return judge(velocity) | {"seconds": round(seconds, 2), "settings": settings, "from": provenance(SOURCES)}


def own(
    name: str, case: str, measured: geometry.Recording, run: Path | None, judge: Callable[[np.ndarray], dict[str, Any]]
) -> dict[str, Any]:
    """The row of a method of torchsph, from a folder of `torchsph assimilate` or made here."""
    method, over_time = name.removesuffix(OVER_TIME), name.endswith(OVER_TIME)
    if run is not None:
        found = geometry.read_recording(str(run / f"{method}.h5"))
        table = json.loads((METHODS / f"filter_methods_{case}.json").read_text(encoding="utf-8"))
        seconds = table["rows"][method]["seconds"]
    else:
        began = time.process_time()
        found = run_methods(measured, (method,))[method].recording
        seconds = time.process_time() - began
    if over_time:
        prepared = PreparedMeasurement(measured, smoothed=found)
        began = time.process_time()
        found = average_over_time(found, prepared.splines, None, prepared.balance).recording
        seconds += time.process_time() - began
    return judge(found.velocity) | {"seconds": round(seconds, 2), "from": provenance((*SOURCES, *ANALYSES))}


def judge_of(
    case: Case, measured: geometry.Recording, truth: geometry.Recording, kept: Path
) -> Callable[[np.ndarray], dict[str, Any]]:
    """What gives a velocity its measures."""
    if case.beats:
        curves = kept_curves(truth, kept)
        return lambda velocity: scores(velocity, measured, truth, curves)

    def velocities_alone(velocity: np.ndarray) -> dict[str, Any]:
        found = evaluate(measured.with_velocity(velocity), truth)
        return {name: found[name].value for name in ("nrmse", "direction_error_deg", "divergence_rms")}

    return velocities_alone


def kept_curves(truth: geometry.Recording, folder: Path) -> dict[str, np.ndarray]:
    """What is read out of the truth, as a file of a folder, made where it is not there."""
    file = folder / f"curves-{truth.frames}.npz"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(file, **read_out(truth, FlowDomain.from_recording(truth)))
    with np.load(file) as found:
        return dict(found)


def show(table: dict[str, Any]) -> None:
    """Print the rows, best first."""
    for case, rows in table["rows"].items():
        print(f"\n{case:22}" + "".join(f"{name[:12]:>14}" for name in COLUMNS))
        for name, row in sorted(rows.items(), key=lambda each: each[1]["nrmse"]):
            print(f"{name:22}" + "".join(f"{cell(row, key):>14}" for key in COLUMNS))


def cell(row: dict[str, Any], key: str) -> str:
    """A number of a row as it is shown."""
    return "" if row.get(key) is None else f"{row[key]:.{DIGITS[key]}f}"


def page(table: dict[str, Any]) -> str:
    """The tables as a page."""
    heading = f"| | {' | '.join(NAMES[key] for key in COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}"
    parts = [PAGE]
    for key, case in CASES.items():
        rows = table["rows"].get(key)
        if not rows:
            continue
        parts += [f"## {case.title}\n", fill(case.about.format(raw=rows.get("raw", {}).get("nrmse", 0.0)), 120), ""]
        parts.append(heading)
        for name, row in sorted(rows.items(), key=lambda each: each[1]["nrmse"]):
            shown = f"**{name}**" if name in OWN else name
            parts.append(f"| {shown} | {' | '.join(cell(row, column) for column in COLUMNS)} |")
        parts.append("")
    return "\n".join(parts).rstrip("\n") + "\n"


def fill_rows(options: argparse.Namespace, name: str, key: str, table: dict[str, Any], kept: Path) -> None:
    """The row of a rival or method in the table of a case, if it is missing or asked for again."""
    case = CASES[key]
    if name in case.leaves_out or (name in table["rows"].get(key, {}) and not options.again):
        return
    measured, truth = case.read(options.data, kept)
    judge = judge_of(case, measured, truth, kept)
    if name == "raw":
        row = judge(filled_velocity(measured)) | {"seconds": 0.0, "from": provenance(SOURCES)}
    elif name in OWN:
        row = own(name, key, measured, options.run, judge)
    else:
        rival, chosen = RIVALS[name], table["settings"].setdefault(name, {})
        if options.tune or case.tuned_at not in chosen:
            chosen[case.tuned_at] = tuned(rival, case.tuned_at, tuning.kept_truth(kept))
            store(options.table, table)
        row = judged(rival, chosen[case.tuned_at]["settings"], measured, judge)
    table["rows"].setdefault(key, {})[name] = row
    store(options.table, table)
    print(f"{name}, {key}: {row['nrmse']:.3f}", file=sys.stderr)


def main(arguments: list[str] | None = None) -> int:
    """Fill the rows that are missing."""
    names = ["raw", *OWN, *RIVALS]
    parser = argparse.ArgumentParser(prog="python -m examples.rivals", description=(about or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)} (default: all)")
    parser.add_argument("--case", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--tune", action="store_true", help="choose settings again, on the tuning ventricle")
    parser.add_argument("--again", action="store_true", help="also rows that are there")
    parser.add_argument(
        "--run", type=Path, help="of spline and ensemble: a folder of torchsph assimilate, with one case"
    )
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the phantom")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    unknown = [name for name in options.names if name not in names]
    if unknown:
        parser.error(f"unknown rival '{unknown[0]}'; known: {', '.join(names)}")
    if options.run is not None and len(options.case) != 1:
        parser.error("--run: name the one --case that the folder is of")
    table, kept = load(options.table), options.table.parent / "kept"
    for name in options.names or names:
        for key in options.case:
            fill_rows(options, name, key, table, kept)
    show(table)
    if options.table == TABLE:
        (ROOT / "examples" / "rivals" / "README.md").write_text(page(table), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
