"""The rooms: which may know which, how full they may be, and how long what stands in them."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

import pytest
from paths import ROOT
from source import PACKAGES, Imports, Module, modules, native_sources

FLOORS = (
    ("geometry", "regularize"),
    ("torchsph.assimilation", "torchsph.native", "torchsph.data"),
    ("torchsph.pairs", "torchsph.ultrasound", "torchsph.evaluation", "torchsph.haemodynamics"),
    ("torchsph.simulator", "torchsph.report"),
    ("torchsph.methods", "torchsph.validation"),
    ("torchsph.cli",),
    ("torchsph",),  # the package's own `__init__` and `__main__`
)
"""Rooms from the ground up; one knows those on the floors below its own, and none beside it."""

FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
LONGEST_FILE, LONGEST_CLASS, LONGEST_FUNCTION = 400, 250, 60
FILES_IN_A_FOLDER = 15
ENTRIES_OF_TORCHSPH = 14


@pytest.fixture(scope="module")
def imports() -> Imports:
    return Imports(modules())


def room(name: str) -> str:
    """The room of a dotted name: a package of its own, or the first folder of `torchsph`."""
    first, *rest = name.split(".")
    return f"torchsph.{rest[0]}" if first == "torchsph" and f"torchsph.{rest[0] if rest else ''}" in FLOOR else first


def write(root: Path, **files: str) -> Imports:
    """Files of a package `torchsph` below `root`, two underscores in a name standing for a folder."""
    for name, text in files.items():
        path = root / "torchsph" / (name.replace("__", "/") + ".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for folder in {path.parent for path in (root / "torchsph").rglob("*.py")}:
        (folder / "__init__.py").touch()
    return Imports(modules("torchsph", root=root))


def test_imports_are_followed_through_what_a_package_hands_on(tmp_path):
    (tmp_path / "torchsph" / "pairs").mkdir(parents=True)
    (tmp_path / "torchsph" / "pairs" / "__init__.py").write_text("from .sums import total\n")
    found = write(
        tmp_path,
        pairs__sums="from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from torchsph.walls import fields\n",
        walls__fields="def near():\n    from torchsph.pairs import total\n",
        walls__alone="import torch\nfrom . import fields\n",
    )
    assert found.edges["torchsph.walls.fields"] == {"torchsph.pairs.sums"}
    assert found.edges["torchsph.walls.alone"] == {"torchsph.walls.fields"}
    assert found.circles() == [["torchsph.pairs.sums", "torchsph.walls.fields"]]


def test_every_folder_of_torchsph_is_a_room():
    folders = {path.name for path in (ROOT / "torchsph").iterdir() if (path / "__init__.py").is_file()}
    assert {f"torchsph.{name}" for name in folders} == {room for room in FLOOR if room.startswith("torchsph.")}


def test_imports_run_down(imports):
    up = sorted(
        f"{name} imports {target}"
        for name, targets in imports.edges.items()
        for target in targets
        if room(name) != room(target)
        and FLOOR[room(target)] >= FLOOR[room(name)]
        and not (target == "torchsph" and name.startswith("torchsph.cli."))  # for the version alone, see below
    )
    assert not up


def test_nothing_but_the_version_is_imported_from_the_package_itself():
    taken = sorted(
        f"{file.shown} takes {name}"
        for file in modules("torchsph")
        for module, name in file.imports()
        if module == "torchsph" and name != "__version__" and not (ROOT / "torchsph" / str(name)).is_dir()
    )
    assert not taken


def test_no_import_goes_in_a_circle(imports):
    assert not imports.circles()


def test_no_two_folders_side_by_side_know_each_other(imports):
    """A folder and the one around it may: an interface stands outside, a registry imports those who meet it."""
    arrows = Counter(
        (imports.files[name].path.parent, imports.files[target].path.parent)
        for name, targets in imports.edges.items()
        for target in targets
    )
    both = sorted(
        f"{a.relative_to(ROOT)} ({arrows[a, b]}) and {b.relative_to(ROOT)} ({arrows[b, a]})"
        for a, b in arrows
        if (b, a) in arrows and a < b and a not in b.parents
    )
    assert not both


def test_no_folder_is_crowded():
    folders = Counter(
        path.parent
        for top in (*PACKAGES, "tests", "examples")
        for path in (ROOT / top).rglob("*.py")
        if path.name != "__init__.py"
    )
    full = {f"{folder.relative_to(ROOT)}: {count}" for folder, count in folders.items() if count > FILES_IN_A_FOLDER}
    assert not full


def test_torchsph_shows_a_dozen_entries_and_its_pages():
    made = {"__pycache__"}
    shown = {path.name for path in (ROOT / "torchsph").iterdir() if path.suffix != ".md"} - made
    assert len(shown) <= ENTRIES_OF_TORCHSPH, sorted(shown)


def length(node: ast.AST, *, docstring: bool) -> int:
    """Lines of a definition, its own docstring counted or not."""
    assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    lines = (node.end_lineno or 0) - node.lineno + 1
    first = node.body[0]
    if docstring or not (isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)):
        return lines
    return lines - ((first.end_lineno or 0) - first.lineno + 1)


def test_lengths_are_counted_without_the_docstring(tmp_path):
    file = tmp_path / "torchsph" / "one.py"
    file.parent.mkdir()
    file.write_text(
        'def f():\n    """One.\n\n    Two.\n    """\n    return 1\n\n\nclass C:\n    def g(self):\n        pass\n'
    )
    found = {name: length(node, docstring=False) for name, node in Module(file, tmp_path).definitions()}
    assert found == {"f": 2, "C": 3, "C.g": 2}


def test_no_file_is_long():
    python = [file.path for file in modules()]
    native = [path for package in PACKAGES for path in native_sources(package)]
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in python + native}
    long = sorted(f"{path.relative_to(ROOT)}: {count}" for path, count in lines.items() if count > LONGEST_FILE)
    assert not long


@pytest.mark.parametrize(
    ("kinds", "longest"),
    [((ast.ClassDef,), LONGEST_CLASS), ((ast.FunctionDef, ast.AsyncFunctionDef), LONGEST_FUNCTION)],
    ids=["classes", "functions"],
)
def test_no_definition_is_long(kinds, longest):
    """Docstrings are not counted: an argument a line must not make a function look long."""
    long = sorted(
        f"{file.shown} {name}: {count}"
        for file in modules()
        for name, node in file.definitions()
        if isinstance(node, kinds) and (count := length(node, docstring=False)) > longest
    )
    assert not long


def test_the_page_shows_the_rooms_from_the_top_down():
    page = (ROOT / "torchsph" / "README.md").read_text(encoding="utf-8")
    places = {room: page.index(f"| `{room.removeprefix('torchsph.')}/`") for room in FLOOR if "." in room}
    floors = [FLOOR[room] for room in sorted(places, key=places.__getitem__)]
    assert floors == sorted(floors, reverse=True)
