"""The reference can be made of the docstrings: names that they write out exist."""

from __future__ import annotations

import runpy

import pytest
from paths import ROOT

REFERENCE = runpy.run_path(str(ROOT / ".ci" / "reference.py"))


def test_names_that_docstrings_write_out_exist():
    assert not REFERENCE["unknown_names"]()


def test_a_name_that_does_not_exist_is_seen():
    assert REFERENCE["exists"]("geometry.Grid.nodes") and REFERENCE["exists"]("torchsph.assimilation.LETKF")
    assert not REFERENCE["exists"]("geometry.Grit") and not REFERENCE["exists"]("torchsph.nowhere.LETKF")


def test_a_link_that_leads_nowhere_is_seen(tmp_path):
    (tmp_path / "a.html").write_text('<a href="b.html#here"></a><a href="c.html"></a><a href="https://x.org"></a>')
    (tmp_path / "b.html").write_text('<p id="there"></p>')
    assert REFERENCE["broken_links"](tmp_path) == ["a.html: b.html#here", "a.html: c.html"]


@pytest.mark.slow  # 20 s
def test_the_reference_is_built_without_broken_references(tmp_path, monkeypatch):
    pytest.importorskip("pdoc", reason='pip install ".[docs]"')
    monkeypatch.setattr("sys.argv", ["reference.py", str(tmp_path)])
    assert REFERENCE["main"]() == 0
    assert (tmp_path / "torchsph.html").is_file()
