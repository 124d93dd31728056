"""`torchsph quantify`: what people read out of a flow, over time and over the beat, as a table, JSON and CSV."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import geometry
from torchsph import __version__
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics.beat import BEAT_UNITS, beat_numbers
from torchsph.haemodynamics.quantities import UNITS, FlowDomain, flow_quantities

from ..arguments import add_output_folder
from ..command import Command
from ..outputs import output_folder, staged, write_json
from ..running.folder_lock import locked
from ..running.provenance import provenance
from ..running.settings import write_config

Curves = dict[str, NDArray[np.float64]]

CAUTION = (
    "At 1 mm and 10 ms do not believe as they stand: wall shear stress, energy loss and vorticity (too small in smooth "
    "fields, too large in raw ones), helicity; a mean field's kinetic energy is too small unless /sigma is there. "
    "For research, not for clinical use."
)


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("analysis", metavar="ANALYSIS.h5", help="velocities: an analysis, a measurement, a truth")
    parser.add_argument("--truth", metavar="TRUTH.h5", help="the true flow, to compare with")
    add_output_folder(parser)


def quantify(args: argparse.Namespace) -> None:
    """`torchsph quantify`: every scalar of one recording, beside the truth's where there is one."""
    folder = output_folder(args.out)
    recording = geometry.read_recording(args.analysis)
    geometry.measurement_type(recording).require_full(f"{args.analysis}: quantities need")
    fields = {"analysis": _curves(recording)}
    if args.truth is not None:
        truth = geometry.read_recording(args.truth)
        fields["truth"] = _curves(truth.select(matching_frames(recording.time, truth.time, "the truth")))
    numbers = {name: beat_numbers(recording.time, curves) for name, curves in fields.items()}
    document = {
        "time": recording.time,
        "units": UNITS | BEAT_UNITS,
        "curves": fields,
        "beat": numbers,
        "caution": CAUTION,
        "config": {
            "torchsph": __version__,
            "analysis": args.analysis,
            "truth": args.truth,
            "info": {"provenance": provenance(args, {"analysis": args.analysis, "truth": args.truth})},
        },
    }
    with locked(folder), staged(folder) as scratch:
        write_json(scratch / "quantities.json", document)
        write_config(scratch, args)
        _write_csv(scratch / "quantities.csv", recording.time, fields)
    for row in _table(fields, numbers):
        print("  ".join(cell.ljust(34) if n == 0 else cell.rjust(12) for n, cell in enumerate(row)).rstrip())
    print(CAUTION)


def _curves(recording: geometry.Recording) -> Curves:
    sigma = recording.sigma if recording.weight is None else None  # of a measurement it is noise, not missing energy
    return flow_quantities(FlowDomain.from_recording(recording), filled_velocity(recording), sigma=sigma)


def _write_csv(path: Path, time: NDArray[np.float64], fields: Mapping[str, Curves]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [(source, name) for source in fields for name in UNITS]
        writer.writerow(["time [s]", *(f"{source} {name} [{UNITS[name]}]" for source, name in names)])
        for frame, t in enumerate(time):
            writer.writerow([f"{t:.9g}", *(f"{fields[source][name][frame]:.9g}" for source, name in names)])


def _table(fields: Mapping[str, Curves], numbers: Mapping[str, Curves]) -> list[list[str]]:
    """RMS over time of every curve, and the numbers of the beat; with a truth the curve's relative error."""
    compared = "truth" in fields
    rows = [["quantity", "unit", *fields, *(["error"] if compared else [])]]
    for name, unit in UNITS.items():
        sizes = [float(np.sqrt(np.mean(curves[name] ** 2))) for curves in fields.values()]
        error = []
        if compared:
            off = float(np.sqrt(np.mean((fields["analysis"][name] - fields["truth"][name]) ** 2)))
            error = [f"{off / sizes[1]:.3f}" if sizes[1] > 0 else "-"]
        rows.append([f"{name} (RMS)", unit, *(f"{size:.4g}" for size in sizes), *error])
    for name, unit in BEAT_UNITS.items():
        values = [float(found[name]) for found in numbers.values()]
        error = [f"{values[0] - values[1]:+.3g}"] if compared else []
        rows.append([name, unit, *(f"{value:.4g}" if np.isfinite(value) else "-" for value in values), *error])
    return rows


COMMAND = Command(
    "quantify",
    "Pressure, energy, forces and flow rates of a recording, over time and over the beat.",
    _arguments,
    quantify,
)
