"""All commands, in the order in which the help lists them, and the parser that is made of them."""

from __future__ import annotations

from collections.abc import Sequence

from torchsph import __version__

from .arguments import Parser
from .command import Command
from .commands import assimilate, convert, export, forecast, info, measure, quantify, smooth

COMMANDS: tuple[Command, ...] = (
    assimilate.COMMAND,
    forecast.COMMAND,
    measure.COMMAND,
    smooth.COMMAND,
    quantify.COMMAND,
    info.COMMAND,
    convert.COMMAND,
    export.COMMAND,
)


def build_parser(commands: Sequence[Command] = COMMANDS) -> Parser:
    """The parser of `torchsph`."""
    parser = Parser(prog="torchsph", description="Flow in the heart from noisy ultrasound velocity recordings.")
    parser.add_argument("--version", action="version", version=f"torchsph {__version__}")
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for command in commands:
        own = subparsers.add_parser(command.name, help=command.help.splitlines()[0], description=command.help)
        own.set_defaults(run=command.run)
        command.arguments(own)
    return parser
