"""`torchsph report`: one page of an analysis, for a browser."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import geometry
from torchsph.evaluation import metrics
from torchsph.evaluation.frames import matching_frames
from torchsph.report import write_report

from ..checks import output_file
from ..command import Command
from ..cures import about
from ..printing import say
from ..running.provenance import provenance
from ..running.small_files import read_small


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("analysis", metavar="ANALYSIS.h5", help="the flow to show")
    parser.add_argument("--measurement", metavar="M.h5", help="what it was made of, to show and to judge")
    parser.add_argument("--truth", metavar="TRUTH.h5", help="the true flow, to show and to compare with")
    parser.add_argument("--quantities", metavar="Q.json", help="what `torchsph quantify` wrote of it, for the curves")
    parser.add_argument("--out", default="report.html", metavar="PAGE.html", help="the page (%(default)s)")


def report(args: argparse.Namespace) -> None:
    """`torchsph report`: planes, curves, pathlines and the measurement's quality in one page."""
    path = output_file(args.out)
    analysis = geometry.read_recording(args.analysis)
    measured, truth = (
        None if name is None else geometry.read_recording(name) for name in (args.measurement, args.truth)
    )
    for name, other in ((args.measurement, measured), (args.truth, truth)):
        if other is not None:
            with about(name):
                matching_frames(analysis.time, other.time, "this recording")
    named = {"raw": measured, "analysis": analysis}
    scores = {
        name: metrics.evaluate(recording, truth, measured) for name, recording in named.items() if recording is not None
    }
    own = geometry.read_provenance(args.analysis)
    inputs = {"analysis": args.analysis, "measurement": args.measurement, "truth": args.truth}
    size = write_report(
        path,
        analysis,
        measured,
        truth=truth,
        title=f"Flow of {Path(args.analysis).name}",
        scores=scores,
        quantities=None if args.quantities is None else _document(args.quantities),
        account={"analysis": own or "the file does not say where it comes from", "page": provenance(args, inputs)},
    )
    say(f"wrote {path} ({size / 1e6:.1f} MB)")


def _document(name: str) -> dict[str, Any]:
    """The document of quantities in a file, refused where it is none."""
    content = read_small(name)
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as fault:
        raise ValueError(f"--quantities {name}: is no JSON ({fault}); give what `torchsph quantify` wrote") from fault
    if not isinstance(found, dict) or "curves" not in found:
        raise ValueError(f"--quantities {name}: has no curves; give what `torchsph quantify` wrote")
    return found


COMMAND = Command(
    "report", "One page of an analysis for a browser: planes over time, curves, pathlines.", _arguments, report
)
