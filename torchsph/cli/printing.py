"""What a command prints: a small table on stdout, notes on stderr; and the account of a run for its files."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import torch

from torchsph import __version__

from .running.notes import LOGGER
from .terminal import printable

# what the document says by other names, or what is no setting of the run
_LEFT_OUT = ("run", "measurement", "method", "config", "verbose", "quiet", "json", "status")


def run_config(args: argparse.Namespace, **extra: Any) -> dict[str, Any]:
    """What was asked for, with versions, for `metrics.json`; ``extra`` goes over what has its name."""
    options = {name: value for name, value in vars(args).items() if name not in _LEFT_OUT}
    return {"torchsph": __version__, "torch": torch.__version__, **options, **extra}


def print_table(rows: Sequence[Sequence[str]], text: bool = False) -> None:
    """Columns lined up: the first to the left, numbers to the right."""
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        first, *rest = zip(row, widths, strict=True)
        cells = [first[0].ljust(first[1])] + [c.ljust(w) if text else c.rjust(w) for c, w in rest]
        print("  ".join(cells).rstrip())


def say(message: str) -> None:
    """A note, on stderr."""
    LOGGER.info("%s", message)
