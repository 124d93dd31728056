#!/usr/bin/env python3
"""The API reference from the docstrings, and no broken reference in it.

    python .ci/reference.py [FOLDER]      # needs the extra `docs` (pdoc); FOLDER defaults to build/reference

Ends with 1 and the list where a link of the pages leads nowhere, or a name that docstrings write out with its package
(`geometry.Grid`, ``torchsph.assimilation``) does not exist.
"""

from __future__ import annotations

import ast
import importlib
import re
import sys
import warnings
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
PACKAGES = ("torchsph", "geometry", "regularize")
# rooms that users import from beside what `torchsph` itself hands on
ROOMS = tuple(
    f"torchsph.{room}" for room in ("assimilation", "evaluation", "haemodynamics", "ultrasound", "validation")
)
NAMED = re.compile(rf"`((?:{'|'.join(PACKAGES)})(?:\.\w+)+)[(`]")
LINK = re.compile(r'href="([^"]+)"')


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            fields = getattr(found, "__dataclass_fields__", {})
            if not hasattr(found, part) and part not in fields:
                return False
            found = getattr(found, part, None)
        return True
    return False


def unknown_names() -> list[str]:
    """Names in docstrings, written out with their package, that are none."""
    found = []
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                    for name in NAMED.findall(ast.get_docstring(node) or ""):
                        if not name.endswith((".py", ".md", ".json")) and not exists(name):
                            found.append(f"{file.relative_to(ROOT)}: {name}")
    return sorted(set(found))


def broken_links(folder: Path) -> list[str]:
    """Links of the pages to files or places that are not there."""
    pages = {page.resolve(): page.read_text(encoding="utf-8") for page in folder.rglob("*.html")}
    found = []
    for page, text in pages.items():
        for link in LINK.findall(text):
            if re.match(r"[a-z]+:", link) or "${" in link:  # elsewhere, or a template of the search's script
                continue
            place, _, anchor = link.partition("#")
            target = (page.parent / place).resolve() if place else page
            if not target.exists() or (anchor and target in pages and f'id="{anchor}"' not in pages[target]):
                found.append(f"{page.relative_to(folder.resolve())}: {link}")
    return sorted(set(found))


def main() -> int:
    """Build, check, tell."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "reference"
    try:
        import pdoc
        import pdoc.render
    except ModuleNotFoundError:
        print('the reference needs pdoc: python -m pip install ".[docs]"', file=sys.stderr)
        return 2
    warnings.simplefilter("ignore")  # of annotations that only a type checker imports
    pdoc.render.configure(docformat="google", math=False)
    pdoc.pdoc(*PACKAGES, *ROOMS, output_directory=folder)
    faults = unknown_names() + broken_links(folder)
    for fault in faults:
        print(fault, file=sys.stderr)
    print(f"{folder / 'index.html'}: {len(faults)} broken references")
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
