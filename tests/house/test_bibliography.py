"""Whatever of the thesis the code of geometry and regularize cites is explained in the package's bibliography."""

from __future__ import annotations

import re

import pytest
from paths import ROOT

PACKAGES = ("geometry", "regularize")
CITED = re.compile(r"Grønli\s+2017,\s+(?:eqs?\.\s+[\d.]+\d(?:(?:,|\s+to|\s+and)\s+(?:eq\.\s+)?[\d.]+\d)*)")
LINE = re.compile(r"\s*\n\s*(?:#|//)?\s*")
LISTED = re.compile(r"^\| eq\. (\d+\.\d+) \|", re.MULTILINE)
NUMBER = re.compile(r"\d+\.\d+")
# the bare ways of citing it that a reader cannot look up
BARE = re.compile(r"\bthesis(?:'s)? (?:eq|sec|table|alg|\d)|\(thesis|ERRATA", re.IGNORECASE)


def sources(package: str) -> dict[str, str]:
    """The text of a package's files with comment marks and line breaks made one space."""
    paths = [path for suffix in ("*.py", "*.cpp", "*.hpp", "*.h") for path in (ROOT / package).rglob(suffix)]
    return {str(path.relative_to(ROOT)): LINE.sub(" ", path.read_text("utf-8")) for path in paths}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_cited_equation_is_listed(package: str) -> None:
    listed = set(LISTED.findall((ROOT / package / "BIBLIOGRAPHY.md").read_text("utf-8")))
    cited = {
        (name, number)
        for name, text in sources(package).items()
        for hit in CITED.findall(text)
        for number in NUMBER.findall(hit)
    }
    assert {(name, number) for name, number in cited if number not in listed} == set()
    assert listed - {number for _, number in cited} == set(), "listed, and cited nowhere"


@pytest.mark.parametrize("package", PACKAGES)
def test_the_thesis_is_cited_by_author_and_year(package: str) -> None:
    assert {(name, hit) for name, text in sources(package).items() for hit in BARE.findall(text)} == set()


def test_the_pattern_finds_citations() -> None:
    text = "see Grønli 2017, eq. 3.22 and Grønli 2017, eq. 3.23, eq. 3.24 and eq. 3.25; Grønli 2017, eqs. 2.1 to 2.3."
    assert NUMBER.findall(" ".join(CITED.findall(text))) == ["3.22", "3.23", "3.24", "3.25", "2.1", "2.3"]
