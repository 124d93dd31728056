"""How C++ sources become one shared library per instruction set; the build scripts of both packages use it.

This file uses only the standard library and is run by path, where there may be no torch.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

# best last; a library of each is built, and the best one that the processor runs is loaded (see ``loader``)
INSTRUCTION_SETS = {
    "baseline": (),
    "avx2": ("-mavx2", "-mfma"),
    "avx512": (
        "-mavx512f",
        "-mavx512dq",
        "-mavx512vl",
        "-mavx512bw",
        "-mavx2",
        "-mfma",
        "-mprefer-vector-width=512",
    ),
}
# headers that all libraries share
SHARED = Path(__file__).resolve().parent / "csrc"


class BuildError(RuntimeError):
    """The compiler is there and failed; the message carries its output."""


@dataclass(frozen=True)
class Part:
    """A source file and how it is compiled into one object.

    Attributes:
        source: file name.
        name: of the object.
        flags: beside those of the library.
    """

    source: str
    name: str
    flags: tuple[str, ...] = ()


def compiler() -> str | None:
    """The C++ compiler: $CXX where it is set, else g++ or clang++ from the path; None where there is none."""
    wanted = os.environ.get("CXX")
    if wanted:
        return shutil.which(wanted.split()[0]) and wanted
    return shutil.which("g++") or shutil.which("clang++")


def instruction_sets() -> tuple[str, ...]:
    """The instruction sets worth compiling for on this architecture."""
    return tuple(INSTRUCTION_SETS) if platform.machine().lower() in ("x86_64", "amd64") else ("baseline",)


def build(
    stem: str, parts: tuple[Part, ...], flags: tuple[str, ...], source: Path, out_dir: Path, jobs: int | None = None
) -> list[Path]:
    """Compile the libraries of all instruction sets.

    Args:
        stem: what the libraries' names begin with.
        parts: what goes into each of them.
        flags: of the compiler, for all parts.
        source: folder of the sources.
        out_dir: folder of the libraries, made where it is missing.
        jobs: compilers at a time; None: one for each processor.

    Returns:
        The libraries; an empty list where this machine has no C++ compiler.

    Raises:
        FileNotFoundError: the sources are not where they should be.
        BuildError: the compiler failed.
    """
    command = compiler()
    if command is None:
        return []
    for part in parts:
        if not (source / part.source).is_file():
            raise FileNotFoundError(f"the source {source / part.source} is missing; reinstall from a complete tree")
    out_dir.mkdir(parents=True, exist_ok=True)
    known = instruction_sets()
    with (
        tempfile.TemporaryDirectory(prefix="torchsph-") as scratch,
        ThreadPoolExecutor(jobs or os.cpu_count()) as pool,
    ):

        def compiled(part: Part, name: str) -> Path:
            target = Path(scratch) / f"{part.name}_{name}.o"
            extra = INSTRUCTION_SETS[name] if len(known) > 1 else ()
            options = (*flags, *extra, *part.flags, f"-I{SHARED}")
            _run([*command.split(), *options, "-c", str(source / part.source), "-o", str(target)])
            return target

        tasks = {(name, part.name): pool.submit(compiled, part, name) for part in parts for name in known}
        return [
            _link(command, [tasks[name, part.name].result() for part in parts], out_dir / f"{stem}_{name}.so")
            for name in known
        ]


def _link(command: str, objects: list[Path], target: Path) -> Path:
    # written under another name first: a running process may have the old library mapped
    fresh = target.with_suffix(".new")
    _run([*command.split(), "-shared", "-fopenmp", "-s", *map(str, objects), "-o", str(fresh)])
    os.replace(fresh, target)
    return target


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(f"{' '.join(command)}\nfailed with status {done.returncode}:\n{done.stderr[-4000:]}")


def report(made: list[Path]) -> int:
    """Say what was made; the exit status of a build script."""
    if not made:
        print(
            "no C++ compiler found (set CXX, or install g++ or clang++); the torch references work without",
            file=sys.stderr,
        )
        return 1
    for path in made:
        print(f"{path} ({path.stat().st_size / 1024:.0f} KiB)")
    return 0
