"""Notes, warnings and faults on their way to stderr: plain lines or JSON, more of them or fewer."""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from ..terminal import printable

LOGGER = logging.getLogger("torchsph")


def add_notes_options(parser: argparse._ArgumentGroup) -> None:
    """How much is told on stderr, and in which form."""
    much = parser.add_mutually_exclusive_group()
    much.add_argument("--verbose", action="store_true", help="tell more on stderr")
    much.add_argument("--quiet", action="store_true", help="tell faults alone, without a progress bar")
    parser.add_argument("--json", action="store_true", help="tell it as one JSON object a line, without a progress bar")


def shows_bar(args: argparse.Namespace) -> bool:
    """Whether a progress bar belongs among the notes."""
    return not (args.quiet or args.json)


@contextmanager
def told(args: argparse.Namespace) -> Iterator[None]:
    """Everything that is logged or warned of inside reaches stderr, as the options ask for."""
    handler = _Terminal()
    handler.setFormatter(_Json(args.command) if args.json else _Plain())
    level, passes_on = LOGGER.level, LOGGER.propagate
    LOGGER.setLevel(logging.ERROR if args.quiet else logging.DEBUG if args.verbose else logging.INFO)
    LOGGER.addHandler(handler)
    LOGGER.propagate = False
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(level)
        LOGGER.propagate = passes_on


def fault(command: str, message: str, code: int, args: argparse.Namespace | None) -> None:
    """Tell what ended a command; it may have ended before its options were read."""
    whole = printable(" ".join(message.split()))
    if args is not None and args.json:
        line = json.dumps({"time": time.time(), "level": "error", "command": command, "code": code, "message": whole})
    else:
        line = f"{f'torchsph {command}'.rstrip()}: error: {whole}"
    _print(line)


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """One line for what the user should know; what is meant for programmers is told by --verbose alone."""
    LOGGER.log(logging.WARNING if category is UserWarning else logging.DEBUG, "%s", " ".join(str(message).split()))


class _Terminal(logging.Handler):
    """Lines on whatever stderr is at the time."""

    def emit(self, record: logging.LogRecord) -> None:
        _print(self.format(record))


class _Plain(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        text = printable(record.getMessage())
        return f"torchsph: warning: {text}" if record.levelno >= logging.WARNING else text


class _Json(logging.Formatter):
    def __init__(self, command: str) -> None:
        super().__init__()
        self.command = command

    def format(self, record: logging.LogRecord) -> str:
        level = record.levelname.lower()
        told = {"time": record.created, "level": level, "command": self.command, "message": record.getMessage()}
        return json.dumps(told)


def _print(line: str) -> None:
    with suppress(OSError, ValueError):  # nobody listens any more: that must not end a run of hours
        print(line, file=sys.stderr, flush=True)
