"""The command line's grammar: options that commands share, and what each value may be.

A value that cannot be meant is refused here, before any file is read, in one line that says what is allowed.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import NoReturn

from torchsph.simulator.schemes.presets import PRESETS

from .terminal import printable

# folder of the results where no other is named
OUT = "torchsph-out"
# in the place of a number: as the budget, or the data, tell
AUTO = "auto"


class Parser(argparse.ArgumentParser):
    """An argument parser whose complaint is one line; the usage is behind `--help`."""

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """Refuse "--option=--", which argparse of Python 3.11 takes for no value at all."""
        for word in args or ():
            if isinstance(word, str) and word.startswith("--") and word.endswith("=--"):
                self.error(f"argument {word[:-3]}: '--' is no value")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Leave with code 2 and one line."""
        self.exit(2, f"{self.prog}: error: {printable(' '.join(message.split()))} (see {self.prog} --help)\n")


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Which simulator, how fine, and on which device."""
    parser.add_argument("--preset", choices=tuple(PRESETS), default="default", help="of the simulator (%(default)s)")
    parser.add_argument(
        "--spacing",
        type=number_or_auto(0, open_below=True),
        metavar="M",
        help="of the particles, m, or auto: by --budget",
    )
    parser.add_argument(
        "--budget",
        type=number(0, open_below=True),
        metavar="S",
        help="seconds for the run: the finest particles are taken that fit",
    )
    parser.add_argument("--device", default="cpu", metavar="D", help="cpu, cuda or cuda:N (%(default)s)")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """How many processes share the work."""
    parser.add_argument(
        "--workers",
        type=whole(1),
        metavar="N",
        help="processes of one thread each that share the work, with the same result (as many as it may use cores)",
    )


def add_seed(parser: argparse.ArgumentParser, metavar: str = "S") -> None:
    """The seed of everything random."""
    parser.add_argument("--seed", type=whole(0), default=0, metavar=metavar, help="of everything random (%(default)s)")


def add_output_folder(parser: argparse.ArgumentParser) -> None:
    """The folder of the results."""
    parser.add_argument("--out", default=OUT, metavar="DIR", help="folder of the results (%(default)s)")


def add_sidecar(parser: argparse.ArgumentParser) -> None:
    """Whether viewers get files of their own beside each analysis."""
    parser.add_argument(
        "--no-sidecar", action="store_true", help="write no NAME.vtkhdf, by which ParaView opens NAME.h5, beside it"
    )


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


def number_or_auto(low: float, open_below: bool = False) -> Callable[[str], float | str]:
    """Such a number, or the word AUTO."""
    convert = number(low, open_below=open_below)
    return lambda text: AUTO if text == AUTO else convert(text)


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
