"""Many recordings: which there are, and the folder of results of each."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .small_files import read_small

LISTS = (".txt", ".lst", ".list")


@dataclass(frozen=True)
class Item:
    """A recording and where its results go.

    Attributes:
        source: the recording's file.
        name: of its folder below the root.
        folder: of its results.
    """

    source: Path
    name: str
    folder: Path


def listed(inputs: Sequence[str], root: str | Path) -> list[Item]:
    """The recordings that files, patterns and lists name, each once, in the order given.

    Args:
        inputs: a file of recordings' names (its name ends in .txt, .lst or .list; a line each, relative to the list's
            folder; empty lines and those that begin with # are left out), a pattern with * or ?, or a recording.
        root: below which each has a folder, named like its file from the deepest folder that all have in common.

    Raises:
        ValueError: nothing is named, a pattern fits no file, or two recordings would share a folder.
        FileNotFoundError: a list is not there.
    """
    sources = list(dict.fromkeys(path for name in inputs for path in _named(name)))
    if not sources:
        raise ValueError(f"{', '.join(inputs)}: names no recording")
    whole = [Path(os.path.abspath(path)) for path in sources]
    common = Path(os.path.commonpath([path.parent for path in whole]))
    items = []
    for source, path in zip(sources, whole, strict=True):
        name = path.relative_to(common).with_suffix("").as_posix()
        items.append(Item(source, name, Path(root) / name))
    seen: dict[str, Path] = {}
    for item in items:
        if item.name in seen:
            raise ValueError(f"{seen[item.name]} and {item.source} would share the folder {item.folder}; rename one")
        seen[item.name] = item.source
    return items


def _named(name: str) -> list[Path]:
    if name.lower().endswith(LISTS):
        folder = Path(name).parent
        lines = (line.strip() for line in read_small(name).decode("utf-8", "surrogateescape").splitlines())
        return [folder / line for line in lines if line and not line.startswith("#")]
    if any(letter in name for letter in "*?[") and not os.path.exists(name):
        found = sorted(glob.glob(name, recursive=True))
        if not found:
            raise ValueError(f"{name}: no file fits the pattern")
        return [Path(path) for path in found]
    return [Path(name)]
