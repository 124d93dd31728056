"""The source of the packages as the house's tests read it: files, their imports, their docstrings and comments."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

from paths import ROOT

PACKAGES = ("geometry", "regularize", "torchsph")
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


@dataclass(frozen=True)
class Module:
    """A Python file of the checkout (or of another tree, for tests of the tests).

    Args:
        path: of the file.
        root: folder in which the packages lie.
    """

    path: Path
    root: Path = ROOT

    @cached_property
    def text(self) -> str:
        """What the file says."""
        return self.path.read_text(encoding="utf-8")

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return ast.parse(self.text)

    @property
    def is_package(self) -> bool:
        """Whether the file is the `__init__.py` of a folder."""
        return self.path.name == "__init__.py"

    @property
    def name(self) -> str:
        """Its dotted name; a package's is that of its folder."""
        parts = self.path.relative_to(self.root).with_suffix("").parts
        return ".".join(parts[:-1] if self.is_package else parts)

    @property
    def shown(self) -> str:
        """Its path as errors name it."""
        return self.path.relative_to(self.root).as_posix()

    def imports(self) -> Iterator[tuple[str, str | None]]:
        """Pairs (module, name in it or None) of all imports, also those for type checking and inside functions."""
        package = self.name.split(".") if self.is_package else self.name.split(".")[:-1]
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Import):
                yield from ((alias.name, None) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = package[: len(package) - node.level + 1] if node.level else []
                module = ".".join([*base, *([node.module] if node.module else [])])
                yield from ((module, alias.name) for alias in node.names)

    def definitions(self) -> Iterator[tuple[str, Definition]]:
        """Functions, classes and methods with their dotted names.

        Left out are what is defined inside functions, and the signatures of an overload, whose implementation speaks
        for them.
        """
        todo: list[tuple[str, ast.AST]] = [("", self.tree)]
        while todo:
            prefix, parent = todo.pop(0)
            for node in ast.iter_child_nodes(parent):
                if isinstance(node, Definition) and not any(_is_overload(mark) for mark in node.decorator_list):
                    yield prefix + node.name, node
                if isinstance(node, ast.ClassDef):
                    todo.append((f"{prefix}{node.name}.", node))
                elif isinstance(node, ast.If | ast.Try):
                    todo.append((prefix, node))

    def prose(self) -> Iterator[tuple[int, str]]:
        """Docstrings and comments with their first lines; comments on successive lines are one text."""
        for node in ast.walk(self.tree):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                yield node.lineno, node.value.value
        first, last, lines = 0, -2, []
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type != tokenize.COMMENT:
                continue
            if token.start[0] != last + 1 and lines:
                yield first, "\n".join(lines)
                lines = []
            if not lines:
                first = token.start[0]
            last = token.start[0]
            lines.append(token.string.lstrip("# "))
        if lines:
            yield first, "\n".join(lines)


@lru_cache(maxsize=32)
def modules(*packages: str, root: Path = ROOT) -> list[Module]:
    """The Python files of packages, all three by default; each is read once."""
    return [Module(path, root) for package in packages or PACKAGES for path in sorted((root / package).rglob("*.py"))]


def native_sources(package: str) -> list[Path]:
    """The C++ files of a package."""
    return sorted(path for path in (ROOT / package).rglob("*") if path.suffix in (".cpp", ".hpp", ".h"))


class Imports:
    """Which file imports which, names that an `__init__.py` hands on being followed to where they are defined."""

    def __init__(self, files: list[Module]) -> None:
        self.files = {file.name: file for file in files}
        self._handed_on = {
            file.name: {alias or module: module for module, alias in file.imports()}
            for file in files
            if file.is_package
        }
        self.edges = {
            name: {
                target
                for module, alias in file.imports()
                if (target := self._target(module, alias)) not in (None, name)
            }
            for name, file in self.files.items()
        }

    def _target(self, module: str, name: str | None) -> str | None:
        """The file that `from module import name` needs, None where it is not one of ours."""
        if name is not None and f"{module}.{name}" in self.files:
            return f"{module}.{name}"
        while name is not None and name in self._handed_on.get(module, {}):
            module = self._handed_on[module][name]
        return module if module in self.files else None

    def circles(self) -> list[list[str]]:
        """Sets of files each of which needs all of the others, packages' `__init__.py` left out."""
        plain = {name: {t for t in targets if not self.files[t].is_package} for name, targets in self.edges.items()}
        reach = {name: _reachable(plain, name) for name in plain if not self.files[name].is_package}
        found = {frozenset(b for b in reach[a] if a in reach.get(b, ())) for a in reach if a in reach[a]}
        return sorted(map(sorted, found))


def _is_overload(decorator: ast.expr) -> bool:
    return ast.unparse(decorator) in ("overload", "typing.overload")


def _reachable(edges: dict[str, set[str]], start: str) -> set[str]:
    seen: set[str] = set()
    todo = list(edges[start])
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += edges[name]
    return seen
