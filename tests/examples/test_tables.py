"""Every table below `examples` says what it comes from, and which of them are older than their code is listed."""

from __future__ import annotations

import json
import re
import sys
import warnings

import pytest
from paths import ROOT

if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))

from examples.provenance import bare, code_hash, origins, stale, tables, write_table

PAGES = ("README.md", "torchsph/**/*.md", "examples/**/*.md", "geometry/**/*.md", "regularize/**/*.md")


def old() -> list[str]:
    found = []
    for file in tables():
        content = json.loads(file.read_text(encoding="utf-8"))
        if any(stale({"from": each}) for each in origins(content)):
            found.append(file.name)
    return found


@pytest.mark.parametrize("file", tables(), ids=lambda file: file.stem)
def test_a_table_says_what_it_comes_from(file):
    found = origins(json.loads(file.read_text(encoding="utf-8")))
    assert found, f"{file.name}: no provenance; write it by examples.provenance.write_table"
    for made in found:
        assert re.fullmatch("[0-9a-f]{40}", made["commit"]) and made["sources"], file.name
        missing = [source for source in made["sources"] if not (ROOT / source).exists()]
        assert not missing, f"{file.name}: {missing}; the code has moved: make it again, or correct its sources"


def test_which_tables_are_older_than_their_code(record_property):
    """A list, not a failure: code goes on, and making all tables again takes hours."""
    found = old()
    record_property("stale tables", ", ".join(found))
    if found:
        warnings.warn(
            f"made by older code: {', '.join(found)}; `python -m examples.provenance` lists the commands", stacklevel=1
        )


def test_tables_and_pictures_that_pages_name_are_there():
    known = {file.name for file in tables()}
    for pattern in PAGES:
        for page in ROOT.glob(pattern):
            text = page.read_text(encoding="utf-8")
            named = set(
                re.findall(r"\b((?:filter|speed|spline|track|robust|quantit|resample|preset|peers)\w*\.json)", text)
            )
            assert named - {"quantities.json"} <= known, page


def test_a_changed_line_makes_a_table_old_and_a_comment_does_not(tmp_path):
    file = ROOT / "examples" / "provenance.py"
    write_table(tmp_path / "table.json", {"rows": [1]}, ("examples/provenance.py",))
    content = json.loads((tmp_path / "table.json").read_text(encoding="utf-8"))
    assert content["rows"] == [1] and not stale(content)
    text = file.read_text(encoding="utf-8")
    (tmp_path / "examples").mkdir()
    for changed, same in ((text + "\n# a remark\n", True), (text + "\nx = 1\n", False)):
        (tmp_path / "examples" / "provenance.py").write_text(changed, encoding="utf-8")
        assert (code_hash(("examples/provenance.py",), tmp_path) == content["from"]["code"]) is same


def test_docstrings_go_wherever_they_stand():
    inner = '        if self:\n            def g():\n                "More."\n                return "kept"\n'
    text = f'class A:\n    """Words."""\n\n    def f(self):\n{inner}'
    assert "Words" not in bare(text) and "More" not in bare(text) and '"kept"' in bare(text)
