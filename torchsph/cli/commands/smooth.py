"""`torchsph smooth`: a B-spline field for each frame of a measurement."""

from __future__ import annotations

import argparse

import geometry
from torchsph.evaluation import figures, metrics
from torchsph.methods.by_name import predicted_memory
from torchsph.methods.measurement.frame_splines import smooth_frames
from torchsph.methods.measurement.over_time import average_over_time
from torchsph.methods.measurement.prepared import PreparedMeasurement
from torchsph.methods.memory import free_memory
from torchsph.methods.runtime.workers import chosen_workers

from ..arguments import AUTO, add_sidecar, add_workers, number_or_auto
from ..checks import full_vectors, informative, output_file
from ..command import Command
from ..outputs import write_analysis
from ..printing import print_table, say
from ..running.notes import shows_bar
from ..running.provenance import provenance


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("measurement", metavar="MEASUREMENT.h5")
    parser.add_argument("--out", required=True, metavar="SMOOTH.h5", help="the smoothed recording")
    parser.add_argument(
        "--over-time",
        type=number_or_auto(0),
        metavar="SECONDS",
        help="average neighbouring frames by a Gaussian of this deviation, or auto: as wide as the frames tell",
    )
    add_workers(parser)
    add_sidecar(parser)


def smooth(args: argparse.Namespace) -> None:
    """`torchsph smooth`: a B-spline field for each frame."""
    path = output_file(args.out)
    measured = full_vectors(geometry.read_recording(args.measurement), args.measurement)
    informative(measured, args.measurement)
    prepared = PreparedMeasurement(measured, progress=shows_bar(args))
    foretold, free = predicted_memory(prepared, ("spline",)), free_memory()
    workers = chosen_workers(
        args.workers, prepared.splines.groups, lambda count: foretold.in_processes(count).fits(free)
    )
    foretold.in_processes(workers).refuse_beyond(free)
    smoothed = smooth_frames(prepared.splines, shows_bar(args), workers)
    if args.over_time is not None:
        asked = None if args.over_time == AUTO else args.over_time
        smoothed, width = average_over_time(smoothed, prepared.splines, asked, prepared.balance)
        say(f"averaged over time by a Gaussian of {1e3 * width:.3g} ms")
    account = provenance(args, {"measurement": args.measurement}) | {"processes": workers}
    write_analysis(path, smoothed, account, sidecar=not args.no_sidecar)
    scores = {name: metrics.evaluate(one, None, measured) for name, one in (("raw", measured), ("spline", smoothed))}
    print_table(figures.scores_table(scores, {}))
    say(f"wrote {len(smoothed.time)} frames to {path}")


COMMAND = Command("smooth", "Fit a B-spline field to each frame of a measurement.", _arguments, smooth)
