"""One dialect of docstring (a summary, then Google's sections, one argument a line), and sources that can be found."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest
from paths import ROOT
from source import PACKAGES, Module, modules, native_sources

SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises", "Examples")
ENTRY = re.compile(r"    (\*{0,2}\w+): \S")
NAME = r"(?:(?:van der|van|von|af|de) )?[A-ZÅØÆÖÄÜÉ][\w'\-éèöøåäüßñć]+"
PAPER = re.compile(rf"({NAME})(?: et al\.?|(?:, {NAME})*,? (?:&|and) {NAME})?,? \(?((?:18|19|20)\d\d)\b")
NUMBER = r"(?:\d[\d.]*\d|\d)"
BETWEEN = r"(?:-|, | and | to )"
NUMBERS = rf"{NUMBER}(?:{BETWEEN}{NUMBER})*"
THESIS = re.compile(
    rf"Grønli 2017,? (eqs?\.|secs?\.|tables?|algorithm|figs?\.) ({NUMBERS}(?:{BETWEEN}eqs?\. {NUMBERS})*)"
)


def documented(file: Module) -> Iterator[tuple[str, ast.AST, str]]:
    """Functions, classes and methods with a docstring, and that docstring."""
    for name, node in file.definitions():
        text = ast.get_docstring(node)
        if text is not None:
            yield name, node, text


def fields_by_class() -> dict[str, set[str]]:
    """What can be documented of each class: annotated fields, arguments of `__init__`, and those of its bases."""
    own: dict[str, set[str]] = {}
    bases: dict[str, list[str]] = {}
    for file in modules():
        for _, node in file.definitions():
            if not isinstance(node, ast.ClassDef):
                continue
            names = {n.target.id for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)}
            names |= {
                n.targets[0].id for n in node.body if isinstance(n, ast.Assign) and isinstance(n.targets[0], ast.Name)
            }
            for method in node.body:
                if isinstance(method, ast.FunctionDef) and method.name == "__init__":
                    names |= set(arguments(method)) | set_on_self(method)
            own[node.name] = own.get(node.name, set()) | names
            bases[node.name] = [ast.unparse(base).split("[")[0].split(".")[-1] for base in node.bases]
    return {name: set().union(*(own[c] for c in _ancestry(name, bases) if c in own)) for name in own}


def set_on_self(method: ast.FunctionDef) -> set[str]:
    """Names of the attributes that a method gives its object."""
    stored = [n for n in ast.walk(method) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)]
    return {n.attr for n in stored if isinstance(n.value, ast.Name) and n.value.id == "self"}


def _ancestry(name: str, bases: dict[str, list[str]]) -> set[str]:
    found = {name}
    for base in bases.get(name, []):
        found |= _ancestry(base, bases)
    return found


def arguments(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """Names of a function's arguments, stars included."""
    taken = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    stars = [f"*{node.args.vararg.arg}"] if node.args.vararg else []
    return taken + stars + ([f"**{node.args.kwarg.arg}"] if node.args.kwarg else [])


def sections(text: str) -> dict[str, list[str]]:
    """Lines of a docstring by section, those before any section under the empty name."""
    found: dict[str, list[str]] = {"": []}
    current = ""
    for line in text.splitlines():
        heading = re.fullmatch(r"(\w+):", line)
        if heading and heading[1] in SECTIONS:
            current = heading[1]
            found[current] = []
        else:
            if current and line and not line.startswith(" "):
                current = ""  # text goes on after a section
            found[current].append(line)
    return found


def faults(text: str, names: set[str]) -> list[str]:
    """What breaks the dialect in a docstring of something with these arguments or fields."""
    parts = sections(text)
    wrong = []
    for section in ("Args", "Attributes"):
        for line in parts.get(section, []):
            if not line.startswith("     ") and line.strip():
                entry = ENTRY.match(line)
                if entry is None:
                    wrong.append(f"not 'name: text' in {section}: {line.strip()!r}")
                elif entry[1] not in names and entry[1].lstrip("*") not in names:
                    wrong.append(f"{section} tells of {entry[1]!r}, which is none")
    before = parts[""]
    for number, line in enumerate(before):
        start = re.match(r"(\w+)((, \w+)*)( \(.*?\))?: ", line)
        if start and start[1] in names and (number == 0 or not before[number - 1].strip()):
            wrong.append(f"{start[1]!r} is told of outside Args")
    if re.search(r"\bRaises\s+(`{0,2}:?\w*:?`?)?[A-Z]\w*(Error|Input|Missing|Failure)\b", "\n".join(before)):
        wrong.append("'Raises ...' in the text: make it a section")
    wrong += [f"{line.strip()!r} is of another dialect" for line in before if re.match(r":\w+ \w+:|-{4,}$", line)]
    return wrong


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("Sum.\n\nArgs:\n    a: (n,), m.\n    b: more,\n        and more.\n\nReturns:\n    It.", None),
        ("Sum.\n\nArgs:\n    a, b: both.", "not 'name: text'"),
        ("Sum.\n\nArgs:\n    c: none.", "which is none"),
        ("Sum.\n\na: first. b: second.", "outside Args"),
        ("Sum. Raises ValueError where a < 0.", "make it a section"),
        ("Sum.\n\n:param a: first.", "another dialect"),
        ("Sum.\n\nParameters\n----------\na : int", "another dialect"),
    ],
)
def test_the_dialect_is_told_from_others(text, says):
    found = faults(text, {"a", "b"})
    assert (not found) if says is None else any(says in fault for fault in found)


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_public_says_what_it_is(package):
    bare = [
        f"{file.shown} {name}"
        for file in modules(package)
        for name, node in file.definitions()
        if not any(part.startswith("_") for part in name.split(".")) and ast.get_docstring(node) is None
    ]
    bare += [file.shown for file in modules(package) if ast.get_docstring(file.tree) is None]
    assert not bare


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_speak_one_dialect(package):
    fields = fields_by_class()
    found = []
    for file in modules(package):
        for name, node, text in documented(file):
            known = fields[node.name] if isinstance(node, ast.ClassDef) else set(arguments(node))
            found += [f"{file.shown} {name}: {fault}" for fault in faults(text, known)]
    assert not found


def prose(package: str) -> Iterator[tuple[str, str]]:
    """What docstrings and comments of a package say, C++ included, in one line each, with where it stands."""
    for file in modules(package):
        for line, text in file.prose():
            yield f"{file.shown}:{line}", " ".join(text.split())
    for path in native_sources(package):
        comments = re.findall(r"(?:^[ \t]*//.*\n)+|//.*|/\*.*?\*/", path.read_text(encoding="utf-8"), re.M | re.S)
        for text in comments:
            yield path.relative_to(ROOT).as_posix(), " ".join(text.replace("//", " ").split())


BARE = re.compile(
    r"""(?ix)
    \bthesis\b [^.]{0,30} \b\d\.\d               # thesis 2.29, thesis (section 3.1)
    | (?<!\w) \( \s* [23]\.\d{1,2} (, \s* [23]\.\d{1,2})* \s* \)   # (2.29), (3.1, 3.2)
    | \bgronli\b                                # spelt Grønli
    | (?-i:\bERRATA\b)                          # what differs from print stands in the bibliography
    """
)
NUMBERED = re.compile(r"\b(?:eqs?\.|equations?|section|sec\.|table|algorithm|fig\.|figure) ?\(?\d+(?:\.\d+)*", re.I)


def bare_citations(text: str) -> list[str]:
    """Citations whose source is not named: the thesis's numbers alone, or a number without author and year."""
    found = [match[0] for match in BARE.finditer(text)]
    for match in NUMBERED.finditer(text):
        named = re.search(r"\b(?:1[6-9]|20)\d\d\b", text[max(0, match.start() - 200) : match.start()])
        if named is None:
            found.append(match[0])
    return found


@pytest.mark.parametrize(
    ("text", "bare"),
    [
        ("Viscosity (Grønli 2017, eq. 2.28).", False),
        ("Wall of Ferrand et al. 2013, eqs. 20-22.", False),
        ("Viscosity (2.28).", True),
        ("Viscosity of thesis eq. 2.28.", True),
        ("See the thesis (section 3.1.2).", True),
        ("Gronli 2017 eq. 2.10", True),
        ("As ERRATA says.", True),
        ("The exponent of eq. 7.", True),
        ("What clamp_min(1.0) and f(2.5) do, by a factor of 2.5 (0.3).", False),
    ],
)
def test_a_bare_citation_is_told_from_a_full_one(text, bare):
    assert bool(bare_citations(text)) is bare


@pytest.mark.parametrize("package", PACKAGES)
def test_no_citation_is_bare(package):
    found = [f"{place}: {what}" for place, text in prose(package) for what in bare_citations(text)]
    assert not found


def bibliography(package: str) -> str:
    """A package's list of sources."""
    return (ROOT / package / "BIBLIOGRAPHY.md").read_text(encoding="utf-8")


def test_a_citation_of_the_thesis_is_read_as_its_numbers():
    assert cited("Grønli 2017, eq. 2.10-2.11; Grønli 2017, sec. 3.1.2 and Grønli 2017, table 4.1") == [
        "eq. 2.10",
        "eq. 2.11",
        "sec. 3.1.2",
        "table 4.1",
    ]
    assert cited("Grønli 2017, eq. 3.22, eq. 3.23 and eq. 3.24; Grønli 2017, eqs. 2.1 to 2.3") == [
        "eq. 3.22",
        "eq. 3.23",
        "eq. 3.24",
        "eq. 2.1",
        "eq. 2.3",
    ]


def cited(text: str) -> list[str]:
    """Equations, sections and tables of the thesis that a text cites, ranges by their ends."""
    found = []
    for kind, numbers in THESIS.findall(text):
        singular = {"eqs.": "eq.", "secs.": "sec.", "tables": "table", "figs.": "fig."}.get(kind, kind)
        found += [f"{singular} {number}" for number in re.findall(NUMBER, numbers)]
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_what_is_cited_of_the_thesis_stands_in_the_bibliography(package):
    places = {number: place for place, text in prose(package) for number in cited(text)}
    assert places, f"{package} cites nothing of the thesis: take it out of this test's list"
    rows = {
        row.strip()
        for line in bibliography(package).splitlines()
        if line.startswith("| ")
        for row in line.split("|")[1:2]
    }
    missing = sorted(f"{number} ({place})" for number, place in places.items() if number not in rows)
    assert not missing
    if package != "torchsph":  # which cites ranges, whose inner numbers are rows of their own
        spare = sorted(row for row in rows if re.fullmatch(rf"eq\. {NUMBER}", row) and row not in places)
        assert not spare, "listed, and cited nowhere"
    assert "Modeling and data assimilation for improved ultrasound" in bibliography(package)


def papers(text: str) -> list[tuple[str, str]]:
    """First authors and years of the papers that a text cites."""
    return [(author.split()[-1], year) for author, year in PAPER.findall(text)]


def test_papers_are_read_as_author_and_year():
    text = "As Antuono et al. 2010; Morris, Fox & Zhu 1997, eq. 3; Monaghan (1989); Trahey, Allison & von Ramm 1987."
    assert papers(text) == [("Antuono", "2010"), ("Morris", "1997"), ("Monaghan", "1989"), ("Trahey", "1987")]


def test_every_paper_that_torchsph_cites_stands_in_its_bibliography():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "torchsph").rglob("*.md"))
    entries = [line for line in pages.splitlines() if line.startswith("- ")]
    missing = sorted(
        {
            f"{author} {year} ({place})"
            for place, text in prose("torchsph")
            for author, year in papers(text)
            if author != "Grønli"  # whose numbers are held above
            and not any(author in entry and f"({year})" in entry for entry in entries)
        }
    )
    assert not missing
