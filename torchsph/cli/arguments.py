"""The command line's grammar: commands, options, and what each value may be.

A value that cannot be meant is refused here, before any file is read, in one line that says what is allowed.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import NoReturn

from torchsph import __version__

from . import convert, export

__all__ = ["OUT", "build_parser"]

OUT = "torchsph-out"
LEADS = (0.005, 0.01, 0.02, 0.04)


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaint is one line; the usage is behind `--help`."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {' '.join(message.split())} (see {self.prog} --help)\n")


def build_parser(commands: dict[str, Callable[[argparse.Namespace], None]], presets: tuple[str, ...]) -> Parser:
    """The parser of `torchsph`; `commands` maps each name to what runs it."""
    parser = Parser(prog="torchsph", description="Flow in the heart from noisy ultrasound velocity recordings.")
    parser.add_argument("--version", action="version", version=f"torchsph {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for name, describe in (
        ("assimilate", _assimilate),
        ("forecast", _forecast),
        ("measure", _measure),
        ("smooth", _smooth),
        ("quantify", _quantify),
        ("info", _info),
        ("convert", convert.describe),
        ("export", export.describe),
    ):
        text = (describe.__doc__ or "").strip()
        sub = subparsers.add_parser(name, help=text.splitlines()[0], description=text)
        sub.set_defaults(run=commands[name])
        describe(sub, presets)
    return parser


def _assimilate(parser: Parser, presets: tuple[str, ...]) -> None:
    """Turn a noisy measured recording into analysed velocity fields.

    Without a file, every method runs on the sample that ships with the package; with a file and no --method,
    the default method alone.
    """
    parser.add_argument("measurement", nargs="?", metavar="MEASUREMENT.h5", help="a recording with /weight or /sigma")
    parser.add_argument("--truth", metavar="TRUTH.h5", help="the true flow, to compute errors against")
    parser.add_argument("--method", type=names, metavar="NAME[,NAME]", help="free, spline, sph, ensemble")
    parser.add_argument(
        "--also",
        action="append",
        default=[],
        metavar="FILE.h5",
        help="a further measurement of the same beat, with its own grid, times and errors (repeatable)",
    )
    _model(parser, presets)
    parser.add_argument("--members", type=whole(2), metavar="N", help="size of the ensemble")
    parser.add_argument(
        "--lag", type=whole(1), metavar="N", help="frames whose data still move the ensemble's earlier analyses (off)"
    )
    parser.add_argument("--resume", action="store_true", help="go on with the ensemble where DIR/checkpoint.pt left it")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="S", help="of everything random (%(default)s)")
    _out(parser)


def _forecast(parser: Parser, presets: tuple[str, ...]) -> None:
    """Forecast a recording from its own frames and compare with the later ones."""
    parser.add_argument("recording", metavar="RECORDING.h5")
    parser.add_argument(
        "--leads",
        type=seconds,
        metavar="S[,S]",
        help=f"lead times in s ({','.join(f'{t:g}' for t in LEADS)})",
    )
    parser.add_argument(
        "--every", type=whole(1), default=1, metavar="K", help="start from each K-th frame (%(default)s)"
    )
    _model(parser, presets)
    parser.add_argument("--seed", type=whole(0), default=0, metavar="S", help="of everything random (%(default)s)")
    parser.add_argument("--save", action="store_true", help="also write the forecasts, one recording for each lead")
    _out(parser)


def _measure(parser: Parser, _: tuple[str, ...]) -> None:
    """Simulate what an ultrasound scanner would measure of a true recording."""
    parser.add_argument("true", metavar="TRUE.h5")
    parser.add_argument("--out", required=True, metavar="M.h5", help="the measured recording")
    parser.add_argument(
        "--mode",
        choices=("noise", "speckle", "doppler"),
        default="noise",
        help="a noise model, or simulated echoes with speckle tracking or colour Doppler (%(default)s)",
    )
    parser.add_argument("--every", type=whole(1), metavar="K", help="keep each K-th frame")
    noise = parser.add_argument_group("noise")
    noise.add_argument("--lateral", type=number(0), metavar="S", help="noise across the beam, m/s")
    noise.add_argument("--axial", type=number(0), metavar="S", help="noise along the beam, m/s")
    noise.add_argument("--outliers", type=number(0, 1), metavar="P", help="share of nodes that hop to a false peak")
    echoes = parser.add_argument_group("speckle, doppler")
    echoes.add_argument("--snr", type=number(-100), metavar="DB", help="of the blood's echoes")
    echoes.add_argument("--prf", type=number(0, open_below=True), metavar="HZ", help="pulses per second")
    echoes.add_argument("--packet", type=whole(2), metavar="N", help="frames of echoes per estimate")
    echoes.add_argument(
        "--apex", type=float, nargs="+", metavar="M", help="x, y, z: beams fan out from there; else parallel"
    )
    echoes.add_argument("--clutter", type=number(0), metavar="DB", help="tissue over blood inside the cavity")
    parser.add_argument("--seed", type=whole(0), default=0, metavar="N", help="of everything random (%(default)s)")


def _smooth(parser: Parser, _: tuple[str, ...]) -> None:
    """Fit a B-spline field to each frame of a measurement."""
    parser.add_argument("measurement", metavar="MEASUREMENT.h5")
    parser.add_argument("--out", required=True, metavar="SMOOTH.h5", help="the smoothed recording")


def _quantify(parser: Parser, _: tuple[str, ...]) -> None:
    """Pressure, energy, forces and flow rates of a recording, over time and over the beat."""
    parser.add_argument("analysis", metavar="ANALYSIS.h5", help="velocities: an analysis, a measurement, a truth")
    parser.add_argument("--truth", metavar="TRUTH.h5", help="the true flow, to compare with")
    _out(parser)


def _info(parser: Parser, _: tuple[str, ...]) -> None:
    """Check a recording against the format and summarise it."""
    parser.add_argument("file", nargs="?", metavar="FILE")
    parser.add_argument("--backends", action="store_true", help="list the pair kernels of this machine")
    parser.add_argument("--strict", action="store_true", help="refuse whatever else is odd about the recording")


def _model(parser: Parser, presets: tuple[str, ...]) -> None:
    parser.add_argument("--preset", choices=presets, default="default", help="of the simulator (%(default)s)")
    parser.add_argument("--spacing", type=number(0, open_below=True), metavar="M", help="of the particles, m")
    parser.add_argument("--device", default="cpu", metavar="D", help="cpu, cuda or cuda:N (%(default)s)")


def _out(parser: Parser) -> None:
    parser.add_argument("--out", default=OUT, metavar="DIR", help="folder of the results (%(default)s)")


# --- values ----------------------------------------------------------------------------------------


def whole(least: int) -> Callable[[str], int]:
    """A whole number that is not below `least`."""

    def convert(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"'{text}' is not a whole number") from None
        if value < least:
            raise argparse.ArgumentTypeError(f"{value} is too small, at least {least} is needed")
        return value

    return convert


def number(low: float, high: float = math.inf, open_below: bool = False) -> Callable[[str], float]:
    """A finite number from `low` (itself excluded where `open_below`) to `high`."""
    rule = f"{'above' if open_below else 'at least'} {low:g}" + ("" if math.isinf(high) else f" and at most {high:g}")

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"'{text}' is not a number") from None
        if not math.isfinite(value) or value < low or value > high or (open_below and value == low):
            raise argparse.ArgumentTypeError(f"{text} is out of range, it must be {rule}")
        return value

    return convert


def seconds(text: str) -> tuple[float, ...]:
    """Lead times in seconds, parted by commas: positive, in order, each once."""
    positive = number(0, open_below=True)
    return tuple(sorted({positive(part) for part in text.split(",")}))


def names(text: str) -> tuple[str, ...]:
    """Names parted by commas, each once, in the order given."""
    parts = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    if "" in parts:
        raise argparse.ArgumentTypeError(f"'{text}' has an empty name; give names parted by commas")
    return parts
