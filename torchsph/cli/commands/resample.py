"""`torchsph resample`: an analysis at other times or on a finer grid, as the model has it between frames."""

from __future__ import annotations

import argparse

import numpy as np

import geometry
from torchsph.methods.by_name import make_model
from torchsph.methods.resample import frame_times, resample
from torchsph.simulator.schemes.presets import PRESETS

from ..arguments import add_seed, number
from ..checks import check_spacing, full_vectors, output_file, usable_device
from ..command import Command
from ..outputs import write_result
from ..printing import say
from ..running.notes import shows_bar
from ..running.provenance import provenance


def _times(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as fault:
        raise argparse.ArgumentTypeError(f"must be numbers of seconds with commas between, not {text!r}") from fault


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("analysis", metavar="ANALYSIS.h5", help="an analysis, or any flow without gaps")
    parser.add_argument("--out", required=True, metavar="R.h5", help="the resampled recording")
    when = parser.add_mutually_exclusive_group()
    when.add_argument("--times", type=_times, metavar="S,S,...", help="the frames' times, s")
    when.add_argument("--frame-rate", type=number(0, open_below=True), metavar="HZ", help="frames a second")
    above = number(0, open_below=True)
    parser.add_argument("--spacing", type=above, metavar="M", help="of the grid, m (as it is)")
    parser.add_argument(
        "--particles", type=above, metavar="M", help="spacing of the particles, m (the recording's grid's)"
    )
    parser.add_argument("--linear", action="store_true", help="straight lines between frames, without the model")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="default", help="of the simulator (%(default)s)")
    parser.add_argument("--device", default="cpu", metavar="D", help="cpu, cuda or cuda:N (%(default)s)")
    add_seed(parser)


def run(args: argparse.Namespace) -> None:
    """`torchsph resample`: other times, another frame rate, a finer grid."""
    path = output_file(args.out)
    analysis = full_vectors(geometry.read_recording(args.analysis), args.analysis)
    times = np.array(args.times) if args.times else analysis.time
    if args.frame_rate is not None:
        times = frame_times(analysis.time, args.frame_rate)
    model = None
    if not args.linear:
        check_spacing(args.particles, analysis)
        model = make_model(analysis, preset=args.preset, spacing=args.particles, device=usable_device(args.device))
    found = resample(analysis, model, times=times, spacing=args.spacing, seed=args.seed, progress=shows_bar(args))
    write_result(path, found, provenance(args, {"analysis": args.analysis}))
    say(f"wrote {found.frames} frames on {' x '.join(str(n) for n in reversed(found.grid.shape))} nodes to {path}")


COMMAND = Command("resample", "An analysis at other times or on a finer grid, by its model.", _arguments, run)
