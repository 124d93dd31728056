"""Tune rivals, judge them, print the table; see the package's text."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import geometry
from torchsph.evaluation.metrics import evaluate
from torchsph.haemodynamics.quantities import FlowDomain

from ..provenance import ROOT, provenance
from . import __doc__ as about
from . import tuning
from .registry import RIVALS, Rival
from .scores import read_out, scores

TABLE = ROOT / "examples" / "rivals" / "results" / "rivals.json"
FILES = {"measured": "lv_phantom_a_measured.h5", "noisy": "lv_phantom_a_noisy.h5"}
SOURCES = ("examples/rivals/methods", "examples/rivals/frames.py", "examples/rivals/scores.py")
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
(`tuning.py`), never on this phantom. Errors are RMS errors over the RMS speed; energy loss and pressure difference are
those of `torchsph.haemodynamics`; seconds are CPU seconds of one thread for 44 frames. `spline` and `ensemble` are
torchsph's own methods, with their defaults (`examples/benchmarks/filter_methods.py`).
"""
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
    rival: Rival,
    settings: dict[str, Any],
    measured: geometry.Recording,
    truth: geometry.Recording,
    curves: dict[str, np.ndarray],
) -> dict[str, Any]:
    """A row of the table: of the phantom, with settings that have never seen it."""
    began = time.process_time()
    velocity = rival.fit(measured, **rival.fixed, **settings)
    seconds = time.process_time() - began
    row = scores(velocity, measured, truth, curves)
    return row | {"seconds": round(seconds, 2), "settings": settings}


def kept_curves(truth: geometry.Recording, folder: Path) -> dict[str, np.ndarray]:
    """What is read out of the truth, as a file of a folder, made where it is not there."""
    file = folder / "curves.npz"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(file, **read_out(truth, FlowDomain.from_recording(truth)))
    with np.load(file) as found:
        return dict(found)


def at_times(truth: geometry.Recording, measured: geometry.Recording) -> geometry.Recording:
    """The true frames at the measurement's times."""
    return truth.select(np.isin(np.rint(1e5 * truth.time), np.rint(1e5 * measured.time)))


def show(table: dict[str, Any]) -> None:
    """Print the rows, best first."""
    for noise, rows in table["rows"].items():
        print(f"\n{noise:22}" + "".join(f"{name[:12]:>14}" for name in COLUMNS))
        for name, row in sorted(rows.items(), key=lambda each: each[1]["nrmse"]):
            print(f"{name:22}" + "".join(f"{row[key]:14.3f}" for key in COLUMNS))


def own_rows(noise: str) -> dict[str, dict[str, Any]]:
    """Rows of torchsph's own methods, from the results of their benchmark."""
    file = ROOT / "examples" / "benchmarks" / "results" / f"filter_methods_{noise}.json"
    found = json.loads(file.read_text(encoding="utf-8"))["measurements"][Path(FILES[noise]).stem]
    return {f"**{name}**": found[name] for name in ("spline", "ensemble")}


def page(table: dict[str, Any]) -> str:
    """The tables as a page."""
    heading = f"| | {' | '.join(NAMES[key] for key in COLUMNS)} |\n|---|{'---|' * len(COLUMNS)}"
    parts = [PAGE]
    for noise, judged_rows in table["rows"].items():
        rows = judged_rows | own_rows(noise)
        parts += [f"## {noise.capitalize()} phantom\n", heading]
        for name, row in sorted(rows.items(), key=lambda each: each[1]["nrmse"]):
            cells = ["" if row.get(key) is None else f"{row[key]:.{DIGITS[key]}f}" for key in COLUMNS]
            parts.append(f"| {name} | {' | '.join(cells)} |")
        parts.append("")
    return "\n".join(parts).rstrip("\n") + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Fill the rows that are missing."""
    parser = argparse.ArgumentParser(prog="python -m examples.rivals", description=(about or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(RIVALS)} (default: all)")
    parser.add_argument("--noise", nargs="*", default=list(FILES), choices=list(FILES))
    parser.add_argument("--tune", action="store_true", help="choose settings again, on the tuning ventricle")
    parser.add_argument("--again", action="store_true", help="also rows that are there")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the phantom")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    unknown = [name for name in options.names if name not in RIVALS]
    if unknown:
        parser.error(f"unknown rival '{unknown[0]}'; known: {', '.join(RIVALS)}")
    table, kept = load(options.table), options.table.parent / "kept"
    curves: dict[str, np.ndarray] = {}
    for name in options.names or list(RIVALS):
        rival = RIVALS[name]
        for noise in options.noise:
            chosen = table["settings"].setdefault(name, {})
            if options.tune or noise not in chosen:
                chosen[noise] = tuned(rival, noise, tuning.kept_truth(kept))
                store(options.table, table)
            if not options.again and name in table["rows"].get(noise, {}):
                continue
            measured = geometry.read_recording(str(options.data / FILES[noise]))
            truth = at_times(geometry.read_recording(str(options.data / "lv_phantom_a.h5")), measured)
            curves = curves or kept_curves(truth, kept)
            row = judged(rival, chosen[noise]["settings"], measured, truth, curves)
            table["rows"].setdefault(noise, {})[name] = row | {"from": provenance(SOURCES)}
            store(options.table, table)
            print(f"{name}, {noise}: {row['nrmse']:.3f}", file=sys.stderr)
    show(table)
    if options.table == TABLE:
        (ROOT / "examples" / "rivals" / "README.md").write_text(page(table), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
