"""Compile the pair kernels: ``python -m torchsph.native.build`` puts them beside the package's sources.

This file uses only the standard library and is also run by path, from the PEP 517 backend, where there is no
torch.
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

SOURCE = Path(__file__).resolve().parent / "csrc"
LIBRARIES = Path(__file__).resolve().parent / "libraries"

# -ffast-math as a whole would reorder sums and, at the link, set flush-to-zero for the whole process
FLAGS = (
    "-std=c++17",
    "-O3",
    "-fPIC",
    "-fopenmp",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-ffinite-math-only",
)
X86 = {
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


class BuildError(RuntimeError):
    """The compiler is there and failed; the message carries its output."""


@dataclass(frozen=True)
class _Object:
    source: str
    name: str
    flags: tuple[str, ...]


_OBJECTS = (
    _Object("pairs.cpp", "pairs_f32", ("-DSPH_REAL=float", "-DSPH_SUFFIX=_f32")),
    _Object("pairs.cpp", "pairs_f64", ("-DSPH_REAL=double", "-DSPH_SUFFIX=_f64")),
    _Object("closest.cpp", "closest", ()),
    _Object("correlation.cpp", "correlation", ()),
    _Object("gridding.cpp", "gridding", ()),
    _Object("images.cpp", "images", ()),
    _Object("look_up.cpp", "look_up", ()),
    _Object("machine.cpp", "machine", ()),
    _Object("walls.cpp", "walls", ()),
)


def compiler() -> str | None:
    """The C++ compiler: $CXX where it is set, else g++ or clang++ from the path; None where there is none."""
    wanted = os.environ.get("CXX")
    if wanted:
        return shutil.which(wanted.split()[0]) and wanted
    return shutil.which("g++") or shutil.which("clang++")


def instruction_sets() -> tuple[str, ...]:
    """The instruction sets worth compiling for on this architecture."""
    return tuple(X86) if platform.machine().lower() in ("x86_64", "amd64") else ("baseline",)


def library_name(instruction_set: str) -> str:
    """File name of the library for ``instruction_set``."""
    return f"pairs_{instruction_set}.so"


def build(out_dir: str | Path, source: str | Path = SOURCE, jobs: int | None = None) -> list[Path]:
    """Compile the libraries of all instruction sets into ``out_dir``.

    Returns:
        The libraries; an empty list where this machine has no C++ compiler.

    Raises:
        FileNotFoundError: the sources are not where they should be.
        BuildError: the compiler failed.
    """
    command = compiler()
    if command is None:
        return []
    source, out_dir = Path(source), Path(out_dir)
    if not (source / "pairs.cpp").is_file():
        raise FileNotFoundError(
            f"the pair kernels' source {source / 'pairs.cpp'} is missing; reinstall from a complete tree"
        )
    out_dir.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory(prefix="torchsph-") as scratch,
        ThreadPoolExecutor(jobs or os.cpu_count()) as pool,
    ):
        tasks = {
            (isa, part.name): pool.submit(_compile, command, source, Path(scratch), isa, part)
            for part in _OBJECTS
            for isa in instruction_sets()
        }
        return [
            _link(command, [tasks[isa, part.name].result() for part in _OBJECTS], out_dir / library_name(isa))
            for isa in instruction_sets()
        ]


def _compile(command: str, source: Path, scratch: Path, isa: str, part: _Object) -> Path:
    target = scratch / f"{part.name}_{isa}.o"
    extra = X86[isa] if len(instruction_sets()) > 1 else ()
    _run([*command.split(), *FLAGS, *extra, *part.flags, "-c", str(source / part.source), "-o", str(target)])
    return target


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


def main() -> int:
    """Build into the source tree and say what was made."""
    made = build(LIBRARIES)
    if not made:
        print(
            "no C++ compiler found (set CXX, or install g++ or clang++); the reference backend works without",
            file=sys.stderr,
        )
        return 1
    for path in made:
        print(f"{path} ({path.stat().st_size / 1024:.0f} KiB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
