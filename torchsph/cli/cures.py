"""Faults that come late, in the words of who runs a command: which file, what happened, what to do about it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .exit_codes import ExitCode

# what names the input, in the options of the commands
_INPUTS = ("recording", "analysis", "true", "file", "measurement")
_SAMPLE = "the sample"


def late_fault(fault: BaseException, code: ExitCode, args: argparse.Namespace | None) -> str | None:
    """What is said of a fault that no check before the work has found.

    Args:
        fault: what was raised.
        code: the exit code that belongs to it.
        args: the options of the command, where they were read.

    Returns:
        One line; None for faults that say all of it themselves.
    """
    if code is ExitCode.MEMORY:
        # here, because they bring torch along
        from torchsph.methods.memory import NotEnoughMemory
        from torchsph.methods.runtime.workers import KilledWorker

        if isinstance(fault, NotEnoughMemory | KilledWorker):  # they say how much, or who, and what to do about it
            return f"{_about(args)}{fault}"
        return f"{_about(args)}out of memory; {_cure(args, _LESS) or 'close other programs, or use a larger machine'}"
    if code is ExitCode.NUMERICAL:
        cure = _cure(args, _CALMER)
        return f"{_about(args)}{str(fault).rstrip('.')}{f'; {cure}' if cure else ''}"
    if code is ExitCode.INPUT and isinstance(fault, ValueError) and not _names_what_was_given(str(fault), args):
        return f"{_about(args)}{fault}"
    return None


@contextmanager
def about(name: str) -> Iterator[None]:
    """Faults of a second input are told by its name, not by that of the command's first.

    Raises:
        ValueError: what was raised within, opened by the name.
    """
    try:
        yield
    except ValueError as fault:
        if name in str(fault):
            raise
        raise ValueError(f"{name}: {fault}") from fault


def _names_what_was_given(text: str, args: argparse.Namespace | None) -> bool:
    """Whether a message names a file or an option of the command."""
    given = () if args is None else vars(args).values()
    words = [word for value in given for word in (value if isinstance(value, list) else [value])]
    paths = [word for word in words if isinstance(word, str) and word]
    # a suffix tells a file from other words, such as "noise"
    named = any(text.startswith(f"{path}: ") or (Path(path).suffix and path in text) for path in paths)
    return named or "--" in text


# option -> what to do with it
_LESS = {"members": "fewer --members", "spacing": "a larger --spacing"}
_CALMER = {"spacing": "another --spacing", "preset": "another --preset"}


def _cure(args: argparse.Namespace | None, ways: dict[str, str]) -> str:
    """The ways that this command has."""
    known = [words for option, words in ways.items() if hasattr(args, option)]
    return f"try {' or '.join(known)}" if known else ""


def _about(args: argparse.Namespace | None) -> str:
    """The input that the command was working on."""
    for name in _INPUTS:
        if hasattr(args, name):
            return f"{getattr(args, name) or _SAMPLE}: "
    return ""
