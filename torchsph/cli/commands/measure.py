"""`torchsph measure`: what an ultrasound scanner would measure of a true recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import geometry
from torchsph.evaluation import figures, metrics

from ..arguments import add_seed, number, whole
from ..checks import output_file
from ..command import Command
from ..outputs import write_result
from ..printing import print_table, say
from ..running.notes import shows_bar
from ..running.provenance import provenance

# a mode's options and what measures with them; looked up when a mode runs, so that the other commands start without it
Mode = tuple[type[Any], Callable[..., geometry.Recording]]


def _noise() -> Mode:
    from torchsph.ultrasound import NoiseModel, measure_noise

    def measure_without_bar(true: geometry.Recording, options: Any, seed: int, *, progress: bool) -> geometry.Recording:
        return measure_noise(true, options, seed)

    return NoiseModel, measure_without_bar


def _speckle() -> Mode:
    from torchsph.ultrasound import SpeckleOptions, measure_speckle

    return SpeckleOptions, measure_speckle


def _doppler() -> Mode:
    from torchsph.ultrasound import DopplerOptions, measure_doppler

    return DopplerOptions, measure_doppler


_MODES: dict[str, Callable[[], Mode]] = {"noise": _noise, "speckle": _speckle, "doppler": _doppler}

# by the modes that know them: fields of the modes' options, and how they are given
_OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "noise": {
        "lateral": {"type": number(0), "metavar": "S", "help": "noise across the beam, m/s"},
        "axial": {"type": number(0), "metavar": "S", "help": "noise along the beam, m/s"},
        "beam-only": {
            "action": "store_true",
            "default": None,
            "help": "the component along the beam alone, as Doppler",
        },
        "nyquist": {"type": number(0, open_below=True), "metavar": "S", "help": "speed at which components wrap, m/s"},
        "outliers": {"type": number(0, 1), "metavar": "P", "help": "share of nodes that hop to a false peak"},
    },
    "speckle, doppler": {
        "snr": {"type": number(-100), "metavar": "DB", "help": "of the blood's echoes"},
        "prf": {"type": number(0, open_below=True), "metavar": "HZ", "help": "pulses per second"},
        "packet": {"type": whole(2), "metavar": "N", "help": "frames of echoes per estimate"},
        "apex": {
            "type": float,
            "nargs": "+",
            "metavar": "M",
            "help": "x, y, z: beams fan out from there; else parallel",
        },
        "clutter": {"type": number(0), "metavar": "DB", "help": "tissue over blood inside the cavity"},
    },
}


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("true", metavar="TRUE.h5")
    parser.add_argument("--out", required=True, metavar="M.h5", help="the measured recording")
    parser.add_argument(
        "--mode",
        choices=tuple(_MODES),
        default="noise",
        help="a noise model, or simulated echoes with speckle tracking or colour Doppler (%(default)s)",
    )
    parser.add_argument("--every", type=whole(1), metavar="K", help="keep each K-th frame")
    for title, options in _OPTIONS.items():
        group = parser.add_argument_group(title)
        for name, how in options.items():
            group.add_argument(f"--{name}", **how)
    add_seed(parser, "N")


def measure(args: argparse.Namespace) -> None:
    """`torchsph measure`: a measurement of a true recording, by a noise model or from simulated echoes."""
    kind, make = _MODES[args.mode]()
    path = output_file(args.out)
    known = {option.name for option in fields(kind)}
    asked = ("every", *(name.replace("-", "_") for options in _OPTIONS.values() for name in options))
    given = {name: value for name in asked if (value := getattr(args, name)) is not None}
    foreign = [f"--{name.replace('_', '-')}" for name in given if name not in known]
    if foreign:
        raise ValueError(f"{', '.join(foreign)}: means nothing with --mode {args.mode}")
    true = geometry.read_recording(args.true)
    measured = make(true, kind(**given), args.seed, progress=shows_bar(args))
    write_result(path, measured, provenance(args, {"true": args.true}))
    if geometry.measurement_type(measured).full:
        print_table(figures.scores_table({"raw": metrics.evaluate(measured, true)}, {}))
    say(f"wrote {len(measured.time)} frames to {path}")


COMMAND = Command(
    "measure", "Simulate what an ultrasound scanner would measure of a true recording.", _arguments, measure
)
