"""Which compiled library fits this processor; torchsph loads its own by the same rule.

``TORCHSPH_ISA`` names an instruction set that is taken in place of the best one: "baseline", "avx2" or "avx512".
"""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass
from pathlib import Path

PREFERENCE = ("avx512", "avx2", "baseline")
FORCED = "TORCHSPH_ISA"


class LibraryMissing(RuntimeError):
    """The compiled code cannot be used here; the message says why and what to do."""


@dataclass(frozen=True)
class Family:
    """The libraries of one package, one for each instruction set.

    Attributes:
        folder: where they are.
        stem: what their names begin with.
        runs: name of their function that tells whether this processor has an instruction set.
        build: module that builds them.
    """

    folder: Path
    stem: str
    runs: str
    build: str

    def path(self, instruction_set: str) -> Path:
        """File of the library for an instruction set."""
        return self.folder / f"{self.stem}_{instruction_set}.so"


@dataclass(frozen=True)
class Loaded:
    """A loaded library and the instruction set it was compiled for."""

    instruction_set: str
    handle: ctypes.CDLL


def choose(family: Family) -> Loaded:
    """The library for the best instruction set of this processor, or for the one that ``TORCHSPH_ISA`` names.

    Raises:
        LibraryMissing: nothing was compiled, or the forced instruction set is unknown or not here.
    """
    if not family.path("baseline").is_file():
        raise LibraryMissing(
            f"the compiled kernels are not in {family.folder}: the install found no C++ compiler. Install "
            f"g++ or clang++ and reinstall, or run 'python -m {family.build}'"
        )
    runs = getattr(load(family, "baseline"), family.runs, None)
    if runs is None:
        raise LibraryMissing(outdated(family, "baseline"))
    forced = os.environ.get(FORCED)
    if forced and forced not in PREFERENCE:
        raise LibraryMissing(f"{FORCED}={forced} is unknown; known: {', '.join(PREFERENCE)}")
    if forced and not runs(forced.encode()):
        raise LibraryMissing(f"{FORCED}={forced} asks for instructions that this processor lacks; unset it")
    candidates = (forced,) if forced else tuple(name for name in PREFERENCE if runs(name.encode()))
    for name in candidates:
        if family.path(name).is_file():
            return Loaded(name, load(family, name))
    raise LibraryMissing(f"no library for {', '.join(candidates)} in {family.folder}; run 'python -m {family.build}'")


def load(family: Family, instruction_set: str) -> ctypes.CDLL:
    """The library for one instruction set.

    Raises:
        LibraryMissing: the file is no library of this machine.
    """
    path = family.path(instruction_set)
    try:
        return ctypes.CDLL(str(path))
    except OSError as problem:
        raise LibraryMissing(
            f"{path} cannot be loaded ({problem}); rebuild with 'python -m {family.build}'"
        ) from problem


def outdated(family: Family, instruction_set: str) -> str:
    """What is said of a library that does not fit the Python beside it."""
    path = family.path(instruction_set)
    return f"{path} was built from other sources than these; rebuild with 'python -m {family.build}'"
