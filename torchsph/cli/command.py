"""What a command of the command line is."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """One command: the parser and the program's help are made from it.

    Attributes:
        name: as it is typed.
        help: a line for the list of commands; what follows it stands in the command's own help.
        arguments: adds the command's arguments to its parser.
        run: does it, with the arguments as they were parsed; an exit code other than 0 may be returned.
    """

    name: str
    help: str
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int | None]
