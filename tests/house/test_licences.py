"""The licences that CONTRIBUTING.md lists are those that the installed packages state, and no package is left out."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageMetadata, PackageNotFoundError, metadata

import pytest
from paths import ROOT

IDENTIFIER = re.compile(r"\b(?:0BSD|Apache-2\.0|BSD-[23]-Clause|BSL-1\.0|CC0-1\.0|MIT|MPL-2\.0|PSF-2\.0|Zlib)(?![\w.])")
# what older metadata say in words of their own, and the identifiers that may be meant
CLASSIFIERS = {
    "MIT License": {"MIT"},
    "BSD License": {"BSD-2-Clause", "BSD-3-Clause"},
    "Apache Software License": {"Apache-2.0"},
    "Python Software Foundation License": {"PSF-2.0"},
    "Mozilla Public License 2.0 (MPL 2.0)": {"MPL-2.0"},
}


def listed() -> dict[str, set[str]]:
    """Identifiers of each package's licences in the table."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = page[page.index("| package | licence | for |") :].split("\n\n")[0].splitlines()[2:]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    return {name.lower(): set(IDENTIFIER.findall(licence)) for names, licence, _ in rows for name in names.split(", ")}


def needed() -> list[str]:
    """Everything that pyproject.toml asks for, the package itself left out."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needs = project["dependencies"] + [need for extra in project["optional-dependencies"].values() for need in extra]
    names = {re.match(r"[\w.-]+", need)[0].lower() for need in needs}
    return sorted(names - {project["name"]})


def disagreement(stated: PackageMetadata, known: set[str]) -> str | None:
    """What a package states and the table lacks; None where all of it is there."""
    for text in (stated.get("License-Expression"), stated.get("License")):
        found = set(IDENTIFIER.findall(text or "")) if text and "\n" not in text else set()
        if found:
            return None if found <= known else f"states {text}"
    told = [line.rpartition(" :: ")[2] for line in stated.get_all("Classifier") or [] if line.startswith("License ::")]
    for name in told:
        if name in CLASSIFIERS and not CLASSIFIERS[name] & known:
            return f"states {name}"
    return None


def test_every_dependency_is_listed() -> None:
    assert sorted(listed()) == needed()
    assert all(listed().values())


@pytest.mark.parametrize("name", needed())
def test_its_licence_is_what_it_states_itself(name: str) -> None:
    try:
        stated = metadata(name)
    except PackageNotFoundError:
        pytest.skip(f"{name} is not installed")
    assert disagreement(stated, listed()[name]) is None


def test_a_licence_that_is_not_listed_is_seen() -> None:
    assert disagreement(metadata("pytest"), {"Apache-2.0"}) == "states MIT"
    assert disagreement(metadata("trimesh"), {"MPL-2.0"}) is not None
