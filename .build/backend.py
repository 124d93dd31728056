"""PEP 517 build backend: setuptools, plus the compiled kernels.

A wheel is made by setuptools and the shared libraries are then added to it. They are plain C libraries, so
the wheel serves every Python 3 on the same kind of machine (`py3-none-linux_x86_64`). Without a C++ compiler
the wheel is built without them and says so; the packages then run on their torch references.
"""

from __future__ import annotations

import base64
import hashlib
import runpy
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import (  # noqa: F401  (hooks that need no change)
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)
from setuptools.command.egg_info import manifest_maker

ROOT = Path(__file__).resolve().parents[1]
# what a source distribution carries beside the packages; kept here because the top level is for the packages
manifest_maker.template = ".build/MANIFEST.in"
# the script whose build(folder) compiles, and the package folder that the libraries go to
NATIVE = (
    ("torchsph/native/build.py", "torchsph/native/libraries"),
    ("regularize/native/build.py", "regularize/native/libraries"),
)


def build_wheel(
    wheel_directory: str, config_settings: dict | None = None, metadata_directory: str | None = None
) -> str:
    """Build the wheel and add the libraries that this machine can compile."""
    name = build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
    with tempfile.TemporaryDirectory(prefix="torchsph-") as scratch:
        libraries = {
            f"{folder}/{path.name}": path
            for script, folder in NATIVE
            for path in _compile(script, Path(scratch) / folder)
        }
        return _with_libraries(Path(wheel_directory) / name, libraries).name if libraries else name


def build_editable(
    wheel_directory: str, config_settings: dict | None = None, metadata_directory: str | None = None
) -> str:
    """Install a link to the source tree, with the libraries compiled into it."""
    for script, folder in NATIVE:
        _compile(script, ROOT / folder)
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


def _compile(script: str, folder: Path) -> list[Path]:
    if not (ROOT / script).is_file():
        return []
    if shutil.which("g++") is None and shutil.which("clang++") is None:
        _say(f"no C++ compiler found: {script} was not run; install g++ or clang++ and reinstall")
        return []
    try:
        made = runpy.run_path(str(ROOT / script))["build"](folder)
    except (OSError, RuntimeError, subprocess.CalledProcessError) as problem:
        # a compiler that cannot do it (no OpenMP, say) must not keep anybody from the torch references
        _say(f"{script} failed, the install goes on without its kernels: {problem}")
        return []
    _say(f"compiled {', '.join(path.name for path in made)}")
    return made


def _say(text: str) -> None:
    print(f"torchsph: {text}", file=sys.stderr, flush=True)


def _with_libraries(wheel: Path, libraries: dict[str, Path]) -> Path:
    """The wheel with ``libraries`` (name inside -> file), tagged for this platform; replaces the given."""
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    target = wheel.with_name(f"{wheel.stem.removesuffix('-py3-none-any')}-py3-none-{platform}.whl")
    with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as out:
        files = {name: source.read(name) for name in source.namelist() if not name.endswith("/RECORD")}
        record = next(name for name in source.namelist() if name.endswith(".dist-info/RECORD"))
        tags = record.removesuffix("RECORD") + "WHEEL"
        files[tags] = (
            files[tags]
            .decode()
            .replace("Root-Is-Purelib: true", "Root-Is-Purelib: false")
            .replace("Tag: py3-none-any", f"Tag: py3-none-{platform}")
            .encode()
        )
        files |= {name: path.read_bytes() for name, path in libraries.items()}
        for name, content in files.items():
            out.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED)
        lines = [f"{name},sha256={_digest(content)},{len(content)}" for name, content in files.items()]
        out.writestr(record, "\n".join([*lines, f"{record},,", ""]))
    wheel.unlink()
    return target


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
