"""Python and C++ agree on every structure that crosses between them, and on every number that stands for a name."""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from torchsph.native import headers, library, structures

CSRC = Path(headers.CSRC)
INTERFACE = (CSRC / "interface.h").read_text(encoding="utf-8")


@pytest.fixture(name="handle")
def _handle():
    try:
        return library.library().handle
    except library.LibraryMissing as missing:
        pytest.skip(str(missing))


def test_the_library_lays_its_structures_out_as_python_does(handle):
    assert library.exported_layouts(handle) == structures.layouts()


def test_every_structure_of_the_interface_has_a_mirror():
    """But for the one with which the library tells the others."""
    declared = set(re.findall(r"^\} (sph_\w+);", INTERFACE, re.MULTILINE))
    assert declared - {"sph_layout"} == set(structures.MIRRORS)


@pytest.mark.parametrize("name", sorted(structures.MIRRORS))
def test_mirrors_have_the_fields_of_the_interface_in_its_order(name):
    body = re.search(rf"typedef struct \{{([^}}]*)\}} {name};", INTERFACE)[1]
    body = re.sub(r"/\*.*?\*/", "", body, flags=re.DOTALL)
    fields = []
    for declaration in filter(None, (part.strip() for part in body.split(";"))):
        declaration = re.sub(r"^(const\s+)?\w+", "", declaration)  # the type's name
        fields += [re.sub(r"\[\d+\]|[\s*]|const\b", "", part) for part in declaration.split(",")]
    assert fields == [field for field, *_ in structures.MIRRORS[name]._fields_]


@pytest.mark.parametrize("name", sorted(headers.headers()))
def test_written_headers_are_those_of_todays_tables(name):
    content = (CSRC / name).read_text(encoding="utf-8")
    assert content == headers.headers()[name], f"csrc/{name} is old: run 'python -m torchsph.native.build'"


def test_headers_are_written_once(tmp_path):
    assert {path.name for path in headers.write(tmp_path)} == set(headers.headers())
    assert headers.write(tmp_path) == []


def test_a_library_of_other_sources_is_refused(handle, monkeypatch):
    """It would read what Python fills at the wrong places."""

    class Longer(ctypes.Structure):
        _fields_ = [*structures.Sizes._fields_, ("more", ctypes.c_int64)]

    monkeypatch.setitem(structures.MIRRORS, "sph_sizes", Longer)
    library.library.cache_clear()
    try:
        with pytest.raises(library.LibraryMissing, match="built from other sources.*python -m torchsph.native.build"):
            library.library()
    finally:
        monkeypatch.undo()
        library.library.cache_clear()


def test_headers_are_written_where_no_package_can_be_imported(tmp_path):
    """A build in isolation has neither the packages nor torch's path: `headers.py` reads its tables by their files."""
    code = f"import runpy; print(len(runpy.run_path({headers.__file__!r})['headers']()))"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0 and int(found.stdout) == len(headers.headers()), found.stderr
