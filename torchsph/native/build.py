"""Compile the kernels: ``python -m torchsph.native.build`` writes headers and puts libraries beside the sources.

This file uses only the standard library and is also run by path, from the PEP 517 backend, where there is no
torch.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
_toolchain = runpy.run_path(str(_HERE.parents[1] / "regularize" / "native" / "toolchain.py"))
_headers = runpy.run_path(str(_HERE / "headers.py"))
BuildError, Part = _toolchain["BuildError"], _toolchain["Part"]

SOURCE, LIBRARIES, STEM = _HERE / "csrc", _HERE / "libraries", "pairs"
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
PARTS = (
    Part("pairs.cpp", "pairs_f32", ("-DSPH_REAL=float", "-DSPH_SUFFIX=_f32")),
    Part("pairs.cpp", "pairs_f64", ("-DSPH_REAL=double", "-DSPH_SUFFIX=_f64")),
    *(
        Part(f"{name}.cpp", name)
        for name in ("closest", "correlation", "gridding", "images", "look_up", "machine", "walls")
    ),
)


def build(out_dir: str | Path, source: str | Path = SOURCE, jobs: int | None = None) -> list[Path]:
    """Write the headers that belong to these sources, and compile the libraries of all instruction sets.

    Args:
        out_dir: folder of the libraries.
        source: folder of the sources.
        jobs: compilers at a time; None: one for each processor.

    Returns:
        The libraries; an empty list where this machine has no C++ compiler.

    Raises:
        FileNotFoundError: the sources are not where they should be.
        BuildError: the compiler failed.
    """
    if Path(source) == SOURCE:
        _headers["write"](SOURCE)
    return _toolchain["build"](STEM, PARTS, FLAGS, Path(source), Path(out_dir), jobs)


if __name__ == "__main__":
    sys.exit(_toolchain["report"](build(LIBRARIES)))
