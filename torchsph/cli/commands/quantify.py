"""`torchsph quantify`: what people read out of a flow, over time and over the beat, as a table, JSON and CSV."""

from __future__ import annotations

import argparse

import geometry
from torchsph import __version__
from torchsph.methods.members.kept import read_members
from torchsph.methods.members.quantities import quantified

from ..arguments import add_output_folder
from ..command import Command
from ..cures import about
from ..outputs import output_folder, staged
from ..quantity_tables import QuantityTables
from ..running.folder_lock import locked
from ..running.provenance import provenance
from ..running.settings import write_config


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("analysis", metavar="ANALYSIS.h5", help="velocities: an analysis, a measurement, a truth")
    parser.add_argument("--truth", metavar="TRUTH.h5", help="the true flow, to compare with")
    parser.add_argument(
        "--members", metavar="MEMBERS.h5", help="the analysis's members (assimilate --keep-members): adds the bands"
    )
    add_output_folder(parser)


def quantify(args: argparse.Namespace) -> None:
    """`torchsph quantify`: every scalar of one recording, beside the truth's where there is one."""
    folder = output_folder(args.out, ["quantities.json", "quantities.csv", "config.toml"])
    recording = geometry.read_recording(args.analysis)
    geometry.measurement_type(recording).require_full(f"{args.analysis}: quantities need")
    truth = None if args.truth is None else geometry.read_recording(args.truth)
    members = None if args.members is None else quantified(recording, read_members(args.members, recording))
    tables = QuantityTables.of(recording, members)
    if truth is not None:
        with about(args.truth):
            tables.compare(truth)
    inputs = {"analysis": args.analysis, "truth": args.truth, "members": args.members}
    config = {"torchsph": __version__, **inputs, "info": {"provenance": provenance(args, inputs)}}
    with locked(folder), staged(folder) as scratch:
        tables.write(scratch, config)
        write_config(scratch, args)
    for line in tables.lines():
        print(line)


COMMAND = Command(
    "quantify",
    "Pressure, energy, forces and flow rates of a recording, over time and over the beat.",
    _arguments,
    quantify,
)
