"""`torchsph export`: a recording as the files of viewers and other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

import geometry
from geometry.formats import EXPORTS
from geometry.formats import export as export_files

from ..command import Command
from ..printing import say


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE.h5", help="a recording")
    parser.add_argument("--to", required=True, choices=tuple(EXPORTS), help="the format")
    parser.add_argument("--out", metavar="NAME", help="of the main file (as FILE, beside it)")


def export(args: argparse.Namespace) -> None:
    """Run `torchsph export`."""
    recording = geometry.read_recording(args.file)
    target = args.out or Path(args.file).with_suffix("")
    written = export_files(recording, target, args.to)
    more = f" and {len(written) - 1} more beside it" if len(written) > 1 else ""
    say(f"wrote {written[0]}{more}")


COMMAND = Command("export", "Write a recording for ParaView, 3D Slicer, MATLAB or xarray.", _arguments, export)
