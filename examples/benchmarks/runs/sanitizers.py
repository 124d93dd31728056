"""The compiled code of both packages under AddressSanitizer and UndefinedBehaviorSanitizer, in the tests that reach it.

    python examples/benchmarks/runs/sanitizers.py [--isa avx2] [--keep FOLDER] [TEST ...]

Builds both libraries with g++ or clang++ ($CXX) and ``-fsanitize=address,undefined`` into a folder of their own, and
runs the tests on them; the first finding ends a run with its stack. Leaks are not looked for: Python and torch keep
memory to the end. Takes minutes to build; --keep and a second run take what is there.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import regularize.native.build as splines
import torchsph.native.build as pairs
from regularize.native import toolchain

SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-fno-omit-frame-pointer", "-g", "-O1")
TESTS = (
    "tests/torchsph/pairs/test_backends.py",
    "tests/torchsph/pairs/test_operators.py",
    "tests/torchsph/pairs/test_poisson.py",
    "tests/torchsph/pairs/test_hard_cases.py",
    "tests/torchsph/pairs/test_refusals.py",
    "tests/torchsph/simulator/walls/test_look_up.py",
    "tests/torchsph/simulator/walls/test_compiled.py",
    "tests/torchsph/ultrasound/estimation/test_correlation.py",
    "tests/torchsph/ultrasound/estimation/test_box_sums.py",
    "tests/torchsph/ultrasound/scanner/test_image.py",
    "tests/regularize/rows/test_battery.py",
    "tests/regularize/solvers/test_battery.py",
    "tests/regularize/solvers/test_cholesky.py",
    "tests/regularize/test_refusals.py",
)
# both packages take their libraries from here; written as a plugin of pytest, which is loaded before any test
PLUGIN = """
from pathlib import Path
import regularize.native.library
import torchsph.native.build
from regularize.native import loader
FOLDER = Path({folder!r})
torchsph.native.build.LIBRARIES = FOLDER
known = regularize.native.library.FAMILY
regularize.native.library.FAMILY = loader.Family(FOLDER, known.stem, known.runs, known.build)
"""


def built(folder: Path, isa: str, jobs: int | None) -> None:
    """Both libraries in a folder, where they are not there yet."""
    compiler = toolchain.compiler()
    if compiler is None:
        raise SystemExit("there is no C++ compiler: set CXX, or install g++ or clang++")
    for family in (splines, pairs):
        target = folder / f"{family.STEM}_{isa}.so"
        if not target.is_file():
            # several -O: the last one counts
            flags = (*family.FLAGS, *toolchain.INSTRUCTION_SETS[isa], *SANITIZE, f"-I{toolchain.SHARED}")
            commands = [
                [*compiler.split(), *flags, *part.flags, "-c", str(family.SOURCE / part.source), "-o", str(name)]
                for part in family.PARTS
                if (name := folder / f"{family.STEM}_{part.name}.o")
            ]
            with ThreadPoolExecutor(jobs) as pool:
                list(pool.map(_run, commands))
            objects = [command[-1] for command in commands]
            _run([*compiler.split(), "-shared", "-fopenmp", *SANITIZE, *objects, "-o", str(target)])
        baseline = folder / f"{family.STEM}_baseline.so"  # which tells what the processor can do
        if not baseline.exists():
            baseline.symlink_to(target.name)


def _run(command: list[str]) -> None:
    print(" ".join(command), flush=True)
    subprocess.run(command, check=True)


def main() -> int:
    """Build, and run the tests; their exit status."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("tests", nargs="*", default=list(TESTS))
    parser.add_argument("--isa", default="avx2" if platform.machine() == "x86_64" else "baseline")
    parser.add_argument("--keep", type=Path, help="folder of the libraries, used again where they are there")
    parser.add_argument("--jobs", type=int, help="compilers at a time")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = (args.keep or Path(scratch)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        built(folder, args.isa, args.jobs)
        (Path(scratch) / "sanitized_libraries.py").write_text(PLUGIN.format(folder=str(folder)), encoding="utf-8")
        runtimes = [
            subprocess.run(
                ["g++", f"-print-file-name={name}"], capture_output=True, text=True, check=True
            ).stdout.strip()
            for name in ("libasan.so", "libubsan.so", "libstdc++.so")  # the last, or exceptions cannot be followed
        ]
        environment = os.environ | {
            "LD_PRELOAD": ":".join(runtimes),
            "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=1:allocator_may_return_null=1",
            "UBSAN_OPTIONS": "print_stacktrace=1",
            "TORCHSPH_ISA": args.isa,
            "PYTHONPATH": os.pathsep.join([scratch, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
        }
        # one test asks for instruction sets of its own
        call = [sys.executable, "-m", "pytest", "-n0", "-q", "-x", "-s", "-k", "not instruction_set"]
        call += ["-p", "sanitized_libraries", *args.tests]
        return subprocess.run(call, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
