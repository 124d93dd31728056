"""What people read out of an apical plane, against the same plane of the truth: raw, splines, ensemble, members.

    python examples/benchmarks/haemodynamics/planes.py TRUTH.h5 MEASURED.h5 [MEASURED.h5 ...] [--members 16]
        [--json FILE]

The plane holds the long axis of the recording's walls and the centres of both openings (three-chamber view); it is cut
out of the truth and of each measurement, and the chain sees nothing else. Errors are of curves over the beat: root mean
square error over the root mean square of the true plane's. "members" is the mean over the ensemble's members, "holds"
the share of frames that their 90 % band holds.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import torch

import geometry
import torchsph as ts
from examples.provenance import ANALYSES, write_table
from torchsph.evaluation.frames import matching_frames
from torchsph.haemodynamics import FlowDomain, coverage, flow_quantities, long_axis
from torchsph.methods.members.quantities import MemberQuantities
from torchsph.methods.models import Models

SOURCES = ("examples/benchmarks/haemodynamics/planes.py", "torchsph/haemodynamics", *ANALYSES)

Place = tuple[list[float], list[float], list[float]]


def three_chambers(recording: geometry.Recording) -> Place:
    """Origin, right and up of the plane."""
    motion = geometry.WallMotion.from_recording(recording)
    start = float(recording.time[0])
    base, apex = long_axis(motion.surface(start))
    inlet, outlet = (opening.at(start).centroid for opening in geometry.orifices(motion)[:2])
    return base.tolist(), (outlet - inlet).tolist(), (base - apex).tolist()


def curves(recording: geometry.Recording) -> dict[str, np.ndarray]:
    """Every quantity of the plane's velocities."""
    return flow_quantities(FlowDomain.from_recording(recording), np.nan_to_num(recording.velocity))


def rows(truth: geometry.Recording, measured: geometry.Recording, members: int) -> dict[str, dict[str, float]]:
    """Errors of each quantity by source, and what the members' bands hold."""
    right, prepared = curves(truth), ts.PreparedMeasurement(measured)
    models, read = Models(prepared, "default", None, "cpu"), MemberQuantities(prepared.recording)
    ts.assimilate(prepared, models.fine, coarse=models.coarse, members=members, seed=0, observers=[read])
    found = read.found()
    bands = found.bands()
    sources = {"raw": curves(measured), "splines": curves(prepared.smoothed), "ensemble": found.estimate}
    sources["members"] = {name: band.mean for name, band in bands.items()}

    def off(curve: np.ndarray, true: np.ndarray) -> float:
        return float(np.sqrt(np.nanmean((curve - true) ** 2) / np.nanmean(true**2)))

    return {
        name: {source: off(each[name], true) for source, each in sources.items()}
        | {"holds": coverage(bands[name], true)}
        for name, true in right.items()
    }


def main() -> None:
    """Compute the tables, print them, write them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path, nargs="+")
    parser.add_argument("--members", type=int, default=16)
    parser.add_argument("--json", type=Path, help="results file")
    options = parser.parse_args()
    torch.set_num_threads(1)
    whole, tables = geometry.read_recording(options.truth), dict[str, Any]()
    place = three_chambers(whole)
    for path in options.measured:
        measured = geometry.read_recording(path)
        truth = geometry.plane_cut(whole.select(matching_frames(measured.time, whole.time, "the truth")), *place)
        tables[path.stem] = rows(truth, geometry.plane_cut(measured, *place), options.members)
        print(path.stem)
        for name, row in tables[path.stem].items():
            print(f"  {name:24s}" + "  ".join(f"{source} {value:.3f}" for source, value in row.items()), flush=True)
    if options.json is not None:
        write_table(options.json, tables, SOURCES)
    else:
        print(json.dumps(tables))


if __name__ == "__main__":
    main()
