#!/usr/bin/env python3
"""The oldest versions that pyproject.toml allows: installed together, and the fast tests of every package run on them.

    python .ci/lower_bounds.py [--torch] [TESTS ...]

torch is this interpreter's own unless `--torch`, which fetches the oldest one (gigabytes where there are GPU builds).
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = (
    "tests/geometry/test_recording.py",
    "tests/geometry/test_surface.py",
    "tests/regularize/test_smoother.py",
    "tests/torchsph/methods/test_checkpoint.py",
    "tests/torchsph/methods/test_quality.py",
    "tests/torchsph/cli/test_outputs.py",
    "tests/torchsph/cli/test_running.py",
)


def oldest(extra: str) -> list[str]:
    """The dependencies and those of an extra, each at its lower bound."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needs = project["dependencies"] + project["optional-dependencies"][extra]
    found = [re.match(r"([\w.-]+)>=([\w.]+)", need) for need in needs]
    return [f"{match[1]}=={match[2]}" for match in found if match is not None]


def main() -> int:
    """Install and test."""
    arguments = sys.argv[1:]
    own_torch = "--torch" not in arguments
    tests = [name for name in arguments if name != "--torch"] or list(TESTS)
    pinned = [need for need in oldest("test") if not (own_torch and need.startswith("torch=="))]
    print(f"Python {sys.version.split()[0]}: {' '.join(pinned)}", flush=True)
    with tempfile.TemporaryDirectory(prefix="torchsph-oldest-") as scratch:
        environment = Path(scratch) / "environment"
        subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
        python = str(environment / "bin" / "python")
        subprocess.run([python, "-m", "pip", "install", "-q", *pinned], check=True)
        if own_torch:  # and what it needs, behind what was pinned
            import torch

            place = sysconfig.get_paths(vars={"base": str(environment), "platbase": str(environment)})["purelib"]
            (Path(place) / "torch.pth").write_text(f"{Path(torch.__file__).parents[1]}\n", encoding="utf-8")
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        call = [python, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", *tests]
        return subprocess.run(call, cwd=ROOT, env={**os.environ, "PYTHONPATH": path}).returncode


if __name__ == "__main__":
    sys.exit(main())
