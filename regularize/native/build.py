"""Compile the assembly and band algebra: ``python -m regularize.native.build``; the install calls ``build``.

This file uses only the standard library and is also run by path, from the PEP 517 backend, where there is no torch.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
_toolchain = runpy.run_path(str(_HERE / "toolchain.py"))

SOURCE, LIBRARIES, STEM = _HERE / "csrc", _HERE / "libraries", "splines"
FLAGS = ("-O3", "-fopenmp", "-fPIC", "-std=c++17", "-fno-math-errno", "-ffp-contract=fast")
PARTS = (_toolchain["Part"]("band.cpp", "band"), _toolchain["Part"]("spline.cpp", "spline"))


def build(out_dir: str | Path, source: str | Path = SOURCE, jobs: int | None = None) -> list[Path]:
    """Compile the libraries of all instruction sets into ``out_dir``; see ``toolchain.build``."""
    return _toolchain["build"](STEM, PARTS, FLAGS, Path(source), Path(out_dir), jobs)


if __name__ == "__main__":
    sys.exit(_toolchain["report"](build(LIBRARIES)))
