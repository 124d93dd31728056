"""Compiles csrc/*.cpp into one shared library per instruction set; the build backend calls build()."""

import platform
import shutil
import subprocess
from pathlib import Path

SOURCES = tuple(sorted((Path(__file__).parent / "csrc").glob("*.cpp")))
FLAGS = ("-O3", "-fopenmp", "-fPIC", "-shared", "-std=c++17", "-fno-math-errno", "-ffp-contract=fast")
VARIANTS = {"base": (), "avx2": ("-mavx2", "-mfma"), "avx512": ("-mavx512f", "-mavx512dq", "-mavx2", "-mfma")}


def build(out_dir: Path | str, *, compiler: str | None = None) -> list[Path]:
    """Compile every variant that this machine's compiler can make into ``out_dir``; returns the files.

    ``compiler`` None takes g++, or else clang++. Raises FileNotFoundError without a compiler and
    subprocess.CalledProcessError, with the compiler's words, when the source does not compile. The variants
    beside the portable one exist on x86-64 only.
    """
    compiler = compiler or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        raise FileNotFoundError("neither g++ nor clang++ was found: install one to compile the assembly")
    out_dir = Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    names = list(VARIANTS) if platform.machine() in ("x86_64", "AMD64") else ["base"]
    made = []
    for name in names:
        target = out_dir / f"_native_{name}.so"
        command = [compiler, *FLAGS, *VARIANTS[name], *map(str, SOURCES), "-o", str(target)]
        subprocess.run(command, check=True, capture_output=True, text=True)
        made.append(target)
    return made


if __name__ == "__main__":
    for path in build(Path(__file__).parent):
        print(path)
