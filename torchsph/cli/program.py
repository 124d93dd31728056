"""All commands, in the order in which the help lists them, and the parser that is made of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from torchsph import __version__

from .arguments import Parser
from .command import Command
from .commands import (
    assimilate,
    batch,
    collect,
    convert,
    export,
    forecast,
    info,
    measure,
    quantify,
    report,
    resample,
    smooth,
)
from .running.notes import add_notes_options
from .running.settings import config_named, take_config

COMMANDS: tuple[Command, ...] = (
    assimilate.COMMAND,
    batch.COMMAND,
    collect.COMMAND,
    forecast.COMMAND,
    measure.COMMAND,
    smooth.COMMAND,
    quantify.COMMAND,
    report.COMMAND,
    resample.COMMAND,
    info.COMMAND,
    convert.COMMAND,
    export.COMMAND,
)

EPILOG = "Exit codes: 0 done, 1 a fault of torchsph, 2 input, 3 memory, 4 numerical, 75 run it again, 130 interrupted."


def build_parser(commands: Sequence[Command] = COMMANDS) -> Parser:
    """The parser of `torchsph`."""
    return _parsers(commands)[0]


def parsed(arguments: Sequence[str], commands: Sequence[Command] = COMMANDS) -> argparse.Namespace:
    """The options of a command line, and those of the file that its ``--config`` names.

    Raises:
        ValueError: the file cannot be meant.
    """
    parser, own = _parsers(commands)
    config = config_named(arguments)
    name = next((word for word in arguments if word in own), None)
    if config is not None and name is not None:
        take_config(own[name], config, name, tuple(own))
    return parser.parse_args(arguments)


def _parsers(commands: Sequence[Command]) -> tuple[Parser, dict[str, Parser]]:
    """The program's parser, and each command's by its name."""
    parser = Parser(prog="torchsph", description="Flow in the heart from noisy ultrasound velocity recordings.")
    parser.add_argument("--version", action="version", version=f"torchsph {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    own: dict[str, Parser] = {}
    for command in commands:
        own[command.name] = subparsers.add_parser(
            command.name, help=command.help.splitlines()[0], description=command.help, epilog=EPILOG
        )
        own[command.name].set_defaults(run=command.run)
        command.arguments(own[command.name])
        running = own[command.name].add_argument_group("running")
        running.add_argument("--config", metavar="FILE.toml", help="options by name, which the command line overrides")
        add_notes_options(running)
    return parser, own
