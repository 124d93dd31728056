"""Who may import whom: the packages stay separable, and what is not shipped is never needed."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from paths import ROOT

OURS = {"geometry", "regularize", "torchsph", "examples", "tests"}
ALLOWED = {
    "geometry": {"geometry"},
    "regularize": {"regularize"},
    "torchsph": {"torchsph", "geometry", "regularize"},
    "examples": {"torchsph", "geometry", "regularize", "examples"},
}
# What pyproject.toml declares; `triton` comes with torch's CUDA builds and is asked for where it is used.
THIRD_PARTY = {
    # what the extra `formats` brings is imported where it is used
    "geometry": {"numpy", "scipy", "trimesh", "h5py", "torch", "vtkmodules", "nibabel", "nrrd", "xarray", "SimpleITK"},
    # triton comes with torch's CUDA builds; pyuff_ustb is the extra `uff`; both are imported where they are used
    "regularize": {"numpy", "scipy", "torch", "triton"},
    "torchsph": {"numpy", "scipy", "trimesh", "h5py", "torch", "tqdm", "matplotlib", "triton", "pyuff_ustb"},
}
MEASURED = ("assimilation", "ultrasound", "methods", "evaluation", "cli")
SIMULATOR = ("simulator", "pairs", "native")


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(path: Path, root: Path = ROOT) -> set[str]:
    """Absolute names of everything that a file below `root` imports, relative imports resolved."""
    found = set()
    package = path.relative_to(root).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{module}.{alias.name}" for alias in node.names} | {module}
    return found


def test_resolving_relative_imports(tmp_path):
    file = tmp_path / "torchsph" / "pairs" / "one.py"
    file.parent.mkdir(parents=True)
    file.write_text("from ..walls import a\nfrom . import b\nimport numpy.linalg\nfrom geometry import Grid\n")
    assert imported(file, tmp_path) >= {"torchsph.walls", "torchsph.pairs.b", "numpy.linalg", "geometry.Grid"}


@pytest.mark.parametrize("package", ALLOWED)
def test_packages_import_only_whom_they_may_know(package):
    offences = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules(package)
        for name in imported(path)
        if name.split(".")[0] in OURS - ALLOWED[package]
    }
    assert modules(package) and not offences


@pytest.mark.parametrize("package", THIRD_PARTY)
def test_every_dependency_is_declared(package):
    import sys

    known = THIRD_PARTY[package] | OURS | set(sys.stdlib_module_names)
    offences = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in modules(package)
        for name in imported(path)
        if name.split(".")[0] not in known
    }
    assert not offences


def test_the_simulator_never_sees_a_measurement():
    """No part of the engine knows the filters or the ultrasound: no inverse crime by construction."""
    engine = [p for p in modules("torchsph") if set(p.relative_to(ROOT).with_suffix("").parts) & set(SIMULATOR)]
    offences = {
        f"{path.name} imports {name}"
        for path in engine
        for name in imported(path)
        if name.startswith(tuple(f"torchsph.{room}" for room in MEASURED))
    }
    assert engine and not offences


def test_the_top_level_holds_only_what_the_design_names():
    named = {
        "geometry",
        "regularize",
        "torchsph",
        "tests",
        "examples",
        "pyproject.toml",
        "README.md",
        "CONTRIBUTING.md",
        "CHANGELOG.md",
        "LICENSE",
        "CITATION.cff",
    }
    made_by_tools = {"build", "dist", "torchsph.egg-info", "torchsph-out", "venv", "shared"}
    found = {path.name for path in ROOT.iterdir() if not path.name.startswith(".")} - made_by_tools
    assert found <= named
