"""A command's options in a TOML file: read as defaults that the command line overrides, written with each result."""

from __future__ import annotations

import argparse
import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..terminal import printable
from .small_files import read_small

# of the program and not of the run, so of no use in a file
_NOT_WRITTEN = ("run", "command", "config")
# what changes no result: where it goes, and what is told of it
SILENT = (
    *(*_NOT_WRITTEN, "out", "status", "verbose", "quiet", "json"),
    *("resume", "minimum_members", "no_sidecar", "workers"),
)


def config_named(arguments: Sequence[str]) -> str | None:
    """The file that ``--config`` names on a command line, before anything else of it is understood."""
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    finder.add_argument("--config")
    try:
        found: str | None = finder.parse_known_args(list(arguments))[0].config
    except argparse.ArgumentError:  # without a name, as the program's own parser will tell
        return None
    return found


def take_config(parser: argparse.ArgumentParser, path: str | Path, command: str, commands: Sequence[str]) -> None:
    """Make the options in a file the defaults of a command.

    Args:
        parser: of the command.
        path: of a TOML file: options by their names, alone or in a table named like the command.
        command: its name.
        commands: names of all of them, whose tables one file may hold.

    Raises:
        ValueError: no TOML, an option that the command does not have, or a value that the option does not take.
    """
    try:
        content = tomllib.loads(read_small(path).decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as fault:
        raise ValueError(f"--config {path}: is no TOML: {fault}") from fault
    tables = {name: value for name, value in content.items() if isinstance(value, dict)}
    for name in tables:
        if name not in commands:
            raise ValueError(f"--config {path}: [{name}] is no command; known are {', '.join(commands)}")
    given = {name: value for name, value in content.items() if name not in tables} | tables.get(command, {})
    actions = {action.dest: action for action in parser._actions if action.dest not in ("help", "config")}
    for name, value in given.items():
        action = actions.get(name.replace("-", "_"))
        if action is None:
            near = difflib.get_close_matches(name.replace("-", "_"), actions, n=1)
            hint = f"; did you mean {near[0].replace('_', '-')}" if near else ""
            raise ValueError(f"--config {path}: torchsph {command} has no option '{name}'{hint}")
        try:
            action.default = _value(action, value)
        except (ValueError, TypeError, argparse.ArgumentTypeError) as fault:
            raise ValueError(f"--config {path}: {name}: {fault}") from fault
        action.required = False
        if not action.option_strings:  # an argument without a name: it may be left out now
            action.nargs = "*" if action.nargs in ("+", "*") else "?"


def _value(action: argparse.Action, value: Any) -> Any:
    """A value of TOML as the option would have it from the command line."""
    if action.nargs == 0:
        if not isinstance(value, bool):
            raise ValueError(f"is true or false, not {value!r}")
        return value
    several = action.nargs in ("+", "*") or isinstance(action, argparse._AppendAction)
    if several:
        return [_one(action, part) for part in (value if isinstance(value, list) else [value])]
    # options that take several values in one word part them by commas
    return _one(action, ",".join(_text(part) for part in value) if isinstance(value, list) else value)


def _one(action: argparse.Action, value: Any) -> Any:
    text = _text(value)
    found = action.type(text) if callable(action.type) else text
    if action.choices is not None and found not in action.choices:
        raise ValueError(f"is one of {', '.join(str(choice) for choice in action.choices)}, not {text}")
    return found


def _text(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"is a number or a text, not {value!r}")
    return repr(value) if isinstance(value, float) else str(value)


def settings_of(args: argparse.Namespace) -> dict[str, Any]:
    """The options that can change a result."""
    return {name: value for name, value in vars(args).items() if name not in SILENT}


def config_text(args: argparse.Namespace) -> str:
    """All options of a run, defaults too, as a file that ``--config`` takes."""
    lines = [f"# torchsph {args.command} --config this-file repeats the run", f"[{args.command}]"]
    for name, value in vars(args).items():
        if name not in _NOT_WRITTEN and value is not None:
            lines.append(f"{name.replace('_', '-')} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def write_config(folder: Path, args: argparse.Namespace) -> None:
    """Write `config.toml`, all options of a run, beside its results."""
    (folder / "config.toml").write_text(config_text(args), encoding="utf-8", errors="backslashreplace")


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(part) for part in value)}]"
    return json.dumps(printable(str(value)), ensure_ascii=False)  # a basic string of TOML is one of JSON


def as_arguments(parser: argparse.ArgumentParser, values: Mapping[str, Any]) -> list[str]:
    """The command line that gives a parser's named options these values; defaults and ``None`` are left out."""
    line: list[str] = []
    for action in parser._actions:
        value = values.get(action.dest)
        if not action.option_strings or value is None or value == parser.get_default(action.dest):
            continue
        name = action.option_strings[-1]
        if action.nargs == 0:
            line += [name] if value else []
        elif isinstance(action, argparse._AppendAction):
            line += [f"{name}={part}" for part in value]
        elif action.nargs in ("+", "*"):
            line += [name, *(str(part) for part in value)]
        else:
            line.append(f"{name}={','.join(str(part) for part in value) if isinstance(value, tuple) else value}")
    return line
