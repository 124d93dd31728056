#!/usr/bin/env python3
"""Source distribution and wheels: made, looked into, installed without a compiler, and run.

    python .ci/package.py            # needs the network for `build`, and torch in the interpreter that runs it

The wheel is made from the source distribution, once with the compiler of this machine and once with none, and each is
installed into an empty environment in which there is no compiler. Dependencies come from this interpreter's
environment. Ends with 1 and what is wrong.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("geometry", "regularize", "torchsph")
# what a build and a run need of the system; no compiler among it
TOOLS = ("env", "sh", "uname", "ldconfig", "ld", "gcc-none", "git")

RUN = """
import json, resource, sys, time
began = time.process_time()
import torchsph
spent = time.process_time() - began
import geometry
from torchsph import cli, data
from torchsph.pairs.registry import available_backends
measured = geometry.read_recording(data.sample_measurement()).select(slice(11, 13))
geometry.write_recording("m.h5", measured)
code = cli.main(["assimilate", "m.h5", "--members", "2", "--spacing", "4e-3", "--out", "out", "--quiet"])
backends = {one.name: one.present for one in available_backends("cpu")}
print(json.dumps({"code": code, "import": spent, "from": torchsph.__file__, "backends": backends}))
"""


def main() -> int:
    """Make, look, install, run."""
    with tempfile.TemporaryDirectory(prefix="torchsph-package-") as scratch:
        work = Path(scratch)
        without = bare_path(work / "bin")
        call(sys.executable, "-m", "venv", "--system-site-packages", str(work / "builder"))
        builder = work / "builder" / "bin" / "python"
        call(str(builder), "-m", "pip", "install", "-q", "build")
        call(str(builder), "-m", "build", "-q", "--sdist", "--outdir", str(work / "dist"), str(ROOT))
        (source,) = (work / "dist").glob("*.tar.gz")
        look_into_source(source)
        for label, path in (("with", os.environ["PATH"]), ("without", without)):
            folder = work / label
            call(str(builder), "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(source), PATH=path)
            (wheel,) = folder.glob("*.whl")
            compiled = look_into_wheel(wheel)
            if compiled and label == "without":
                raise SystemExit(f"{wheel.name}: holds libraries, but no compiler was to be found")
            found = install_and_run(wheel, work / f"{label}-environment", without)
            print(f"{wheel.name}: {compiled} libraries, built {label} a compiler; {found}")
    return 0


def call(*command: str, **environment: str) -> str:
    """Run a command; its output, or its fault."""
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    if done.returncode:
        raise SystemExit(
            f"{' '.join(command)}: ended with {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        )
    return done.stdout


def bare_path(folder: Path) -> str:
    """A PATH on which no compiler is."""
    folder.mkdir(parents=True)
    for name in TOOLS:
        where = shutil.which(name)
        if where is not None:
            (folder / name).symlink_to(where)
    if shutil.which("g++", path=str(folder)) or shutil.which("clang++", path=str(folder)):
        raise SystemExit("a compiler got onto the bare path")
    return str(folder)


def modules() -> set[str]:
    """Every Python file, C++ source and sample that is in the packages of the checkout."""
    kinds = ("*.py", "*.cpp", "*.hpp", "*.h", "*.h5")
    found = {path for name in PACKAGES for kind in kinds for path in (ROOT / name).rglob(kind)}
    return {path.relative_to(ROOT).as_posix() for path in found if "__pycache__" not in path.parts}


def look_into_source(source: Path) -> None:
    """Everything that a build needs is in it."""
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    missing = (modules() | {"pyproject.toml", "LICENSE", "README.md", ".build/backend.py"}) - names
    if missing:
        raise SystemExit(f"{source.name}: lacks {sorted(missing)}")


def look_into_wheel(wheel: Path) -> int:
    """All modules, the licence, nothing of the tests; the number of compiled libraries."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    missing = modules() - names
    strange = {name for name in names if name.split("/")[0] not in PACKAGES and ".dist-info/" not in name}
    licensed = any(name.endswith("LICENSE") for name in names)
    if missing or strange or not licensed:
        raise SystemExit(f"{wheel.name}: lacks {sorted(missing)}, licence {licensed}, and holds {sorted(strange)}")
    return sum(name.endswith(".so") for name in names)


def install_and_run(wheel: Path, environment: Path, path: str) -> str:
    """An analysis of two frames of the sample in an environment that has the wheel and its dependencies alone."""
    call(sys.executable, "-m", "venv", str(environment))
    python = environment / "bin" / "python"
    call(str(python), "-m", "pip", "install", "-q", "--no-deps", str(wheel), PATH=path)
    own = Path(sysconfig.get_paths(vars={"base": str(environment), "platbase": str(environment)})["purelib"])
    elsewhere = [entry for entry in sys.path if entry.endswith("-packages") and entry != str(own)]
    (own / "dependencies.pth").write_text("\n".join(elsewhere) + "\n")  # after the environment's own
    folder = environment / "run"
    folder.mkdir()
    began = time.monotonic()
    program = f"import os; os.chdir({str(folder)!r})\n{RUN}"
    told = json.loads(call(str(python), "-W", "ignore", "-c", program, PATH=path, OMP_NUM_THREADS="1").splitlines()[-1])
    if told["code"] or not told["from"].startswith(str(environment)) or not (folder / "out" / "metrics.json").is_file():
        raise SystemExit(f"{wheel.name}: does not run: {told}")
    if told["import"] > 1.5:
        raise SystemExit(f"{wheel.name}: importing it takes {told['import']:.1f} s of CPU, more than 1.5")
    present = ", ".join(name for name, there in told["backends"].items() if there)
    return f"runs on {present} in {time.monotonic() - began:.0f} s, imported in {told['import']:.2f} s"


if __name__ == "__main__":
    sys.exit(main())
