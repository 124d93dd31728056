"""The pages say what is so: files that they name are there, links lead somewhere, lines can be read."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from paths import ROOT

PAGES = [
    *sorted(ROOT.glob("*.md")),
    *sorted(page for package in ("geometry", "regularize", "torchsph") for page in (ROOT / package).glob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]
NAMED = re.compile(r"`([\w./-]+\.(?:py|cpp|hpp|h|md|json|toml|png)|[\w.-]+(?:/[\w.-]+)+/?)`")
MADE = {  # by commands and by the build
    "metrics.json",
    "quantities.json",
    "report.png",
    "report.html",
    "filter.png",
    "checkpoint.pt",
    "analysis.h5",
    "slow_runs.json",
    "terms.hpp",
}


def found(name: str, page: Path) -> bool:
    """Whether a file of that name, or of that end of a path, is in the checkout."""
    if (ROOT / name).exists() or (page.parent / name).exists():
        return True
    return any(path.as_posix().endswith(f"/{name.rstrip('/')}") for path in ROOT.glob(f"**/{Path(name).name}"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_that_a_page_names_are_there(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    named = {name for name in NAMED.findall(text) if Path(name).name not in MADE}
    named = {name for name in named if "NAME" not in name and "..." not in name and not name.startswith(("/", "../"))}
    assert not sorted(name for name in named if not found(name, page))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_a_page_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#:\s]+)\)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_lines_of_a_page_can_be_read(page):
    """Tables and the entries of a bibliography are one line each, however long."""
    lines = page.read_text(encoding="utf-8").splitlines()
    entries = page.name == "BIBLIOGRAPHY.md"
    long = [line for line in lines if len(line) > 120 and not line.startswith(("|", "!", "`"))]
    assert not [line for line in long if not (entries and line.startswith("- "))]


def test_a_file_that_is_not_there_is_seen():
    assert found("tests/house/test_pages.py", ROOT / "README.md")
    assert found("test_pages.py", ROOT / "README.md")
    assert not found("tests/house/nowhere.py", ROOT / "README.md")
