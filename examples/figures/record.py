"""What a figure leaves beside its picture: numbers, settings and where they come from, and whether they are current."""

from __future__ import annotations

import ast
import hashlib
import json
import platform
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {".py", ".cpp", ".hpp", ".h"}


@dataclass(frozen=True)
class Claim:
    """Something that Grønli 2017 observed, and whether it is seen here.

    Attributes:
        observed_in_thesis: in words.
        seen_here: whether it is.
        number: what says so, in words with its number.
    """

    observed_in_thesis: str
    seen_here: bool
    number: str


@dataclass(frozen=True)
class Result:
    """What a script hands over.

    Attributes:
        numbers: what the picture shows, as JSON can hold it.
        claims: what the thesis says of it.
        settings: what the numbers depend on beside the code.
        draw: makes the picture.
    """

    numbers: dict[str, Any]
    claims: list[Claim]
    settings: dict[str, Any]
    draw: Callable[[], Figure] = field(repr=False)


def code_hash(sources: Sequence[str], root: Path = ROOT) -> str:
    """Hash of source files and folders (relative to ``root``) without comments, docstrings and empty lines.

    A page or a comment that was rewritten makes no number stale; a line of code does. Tests without git can check it.

    Raises:
        FileNotFoundError: one of the sources is not there.
    """
    digest = hashlib.sha256()
    for source in sources:
        place = root / source
        if not place.exists():
            raise FileNotFoundError(f"{source}: no such file or folder in {root}; correct the figure's sources")
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        for file in files:
            if file.suffix in SOURCES and file.is_file():
                text = file.read_text(encoding="utf-8")
                digest.update(file.relative_to(root).as_posix().encode())
                digest.update((bare(text) if file.suffix == ".py" else text).encode())
    return digest.hexdigest()[:16]


def bare(text: str) -> str:
    """Python source without its docstrings, lines of comment and empty lines."""
    lines = text.split("\n")
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                lines[value.lineno - 1 : value.end_lineno] = [""] * (value.end_lineno - value.lineno + 1)
    return "\n".join(line for line in lines if line.strip() and not line.lstrip().startswith("#"))


def provenance(sources: Sequence[str]) -> dict[str, Any]:
    """Commit, hash of the code, machine: from what numbers come."""
    try:
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
        commit = found.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    return {
        "commit": commit,
        "code": code_hash(sources),
        "sources": list(sources),
        "device": f"cpu ({platform.machine()}), {torch.get_num_threads()} thread(s)",
        "torch": torch.__version__,
    }


def write(file: Path, about: dict[str, Any], result: Result, sources: Sequence[str], seconds: float) -> None:
    """Write the JSON of a figure: it appears whole or not at all."""
    content = about | {
        "settings": result.settings,
        "claims": [asdict(claim) for claim in result.claims],
        "numbers": result.numbers,
        "seconds": round(seconds, 1),
        "from": provenance(sources),
    }
    part = file.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    part.replace(file)


def is_current(file: Path, fast: bool) -> bool:
    """Whether a JSON is there that the present code has made, in the same variant."""
    if not file.is_file():
        return False
    content = json.loads(file.read_text(encoding="utf-8"))
    return content.get("fast") == fast and not stale(content)


def stale(content: dict[str, Any]) -> bool:
    """Whether code that a JSON speaks of has changed since."""
    made = content["from"]
    try:
        return code_hash(made["sources"]) != made["code"]
    except FileNotFoundError:
        return True
