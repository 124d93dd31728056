"""From what code a table or figure comes: its commit, its command and a hash that tells when that code has changed.

    python -m examples.provenance

lists every table below ``examples`` with its commit, whether code that it speaks of has changed since, and the command
that makes it again.
"""

from __future__ import annotations

import ast
import hashlib
import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = {".py", ".cpp", ".hpp", ".h"}

# what most tables depend on
SPLINES = ("geometry", "regularize", "torchsph/methods/measurement")
MODEL = ("geometry", "torchsph/simulator", "torchsph/pairs", "torchsph/native/csrc")
ANALYSES = (*MODEL, "regularize", "torchsph/methods", "torchsph/assimilation", "torchsph/evaluation")
TRACKING = ("geometry", "torchsph/ultrasound")


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
            raise FileNotFoundError(f"{source}: no such file or folder in {root}; correct the table's sources")
        files = sorted(place.rglob("*")) if place.is_dir() else [place]
        for file in files:
            if file.suffix in SUFFIXES and file.is_file():
                text = file.read_text(encoding="utf-8")
                digest.update(file.relative_to(root).as_posix().encode())
                digest.update((bare(text) if file.suffix == ".py" else text).encode())
    return digest.hexdigest()[:16]


@lru_cache(maxsize=4096)
def bare(text: str) -> str:
    """Python source without its docstrings, lines of comment and empty lines."""
    lines = text.split("\n")
    waiting: list[ast.AST] = [ast.parse(text)]
    while waiting:
        node = waiting.pop()
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                lines[value.lineno - 1 : value.end_lineno] = [""] * (value.end_lineno - value.lineno + 1)
        for part in (
            "body",
            "orelse",
            "finalbody",
            "handlers",
            "cases",
        ):  # statements alone: expressions hold no docstring
            inner = getattr(node, part, None)
            waiting += inner if isinstance(inner, list) else []
    return "\n".join(line for line in lines if line.strip() and not line.lstrip().startswith("#"))


def provenance(sources: Sequence[str]) -> dict[str, Any]:
    """Commit, hash of the code, command, machine: from what numbers come."""
    try:
        found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
        commit = found.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    return {
        "commit": commit,
        "code": code_hash(sources),
        "sources": list(sources),
        "command": command(),
        "device": f"cpu ({platform.machine()}), {torch.get_num_threads()} thread(s)",
        "torch": torch.__version__,
    }


def command() -> str:
    """The command that is running: the script from the checkout's root on, of every file its name alone."""
    script = Path(sys.argv[0]).resolve()
    if not script.is_relative_to(ROOT):
        return "unknown"
    path = script.relative_to(ROOT)
    named = path.as_posix() if path.stem != "__main__" else "-m " + ".".join(path.parent.parts)
    return f"python {named} " + shlex.join(Path(each).name if "/" in each else each for each in sys.argv[1:])


def write_table(file: Path, content: dict[str, Any], sources: Sequence[str], **more: str) -> None:
    """Write a table with where it comes from, under "from"; it appears whole or not at all.

    Args:
        file: to write.
        content: the table, as JSON can hold it.
        sources: files and folders below the root whose change makes it stale.
        more: what else "from" says, or says otherwise than this run.
    """
    content = {name: value for name, value in content.items() if name != "from"} | {"from": provenance(sources) | more}
    part = file.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    part.replace(file)


def stale(content: dict[str, Any]) -> bool:
    """Whether code that a table or figure speaks of has changed since it was made."""
    made = content["from"]
    try:
        return code_hash(made["sources"]) != made["code"]
    except FileNotFoundError:
        return True


def tables() -> list[Path]:
    """All tables and figures' numbers of the checkout."""
    return sorted((ROOT / "examples").glob("*/results/*.json"))


def origins(content: object) -> list[dict[str, Any]]:
    """Where a table comes from, and those of its rows that say it themselves."""
    if not isinstance(content, dict):
        return []
    own = [content["from"]] if isinstance(content.get("from"), dict) else []
    return own + [each for name, inner in content.items() if name != "from" for each in origins(inner)]


def main() -> int:
    """Print the list; 0 whatever it says."""
    for file in tables():
        found = origins(json.loads(file.read_text(encoding="utf-8")))
        old = sum(stale({"from": made}) for made in found)
        state = "no provenance" if not found else "current" if not old else f"older, {old} of {len(found)}"
        commit, made = (found[0]["commit"][:8], found[0].get("command", "")) if found else ("", "")
        print(f"{file.relative_to(ROOT / 'examples').as_posix():52s}{commit:9s}{state:15s}{made}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
