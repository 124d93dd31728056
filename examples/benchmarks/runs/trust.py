"""The table of what was done to torchsph on purpose: abuses, mutants, soak and memory, gathered from their scripts.

    python examples/benchmarks/runs/abuses.py --part 0.2 --out abuses.json
    python examples/benchmarks/mutants.py --mutants 500 --seed 5 --out mutants.json
    python examples/benchmarks/soak.py --scenes 60 --seed 7 --out soak.json
    python examples/benchmarks/runs/memory.py --out memory.json
    python examples/benchmarks/runs/trust.py --abuses abuses.json --mutants mutants.json \\
        --soak soak.json --memory memory.json

A part that is not named keeps what the table has of it, with the commit of its own run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT))

from examples.provenance import provenance, write_table  # noqa: E402

TABLE = Path(__file__).parents[1] / "results" / "trust.json"
PACKAGES = ("geometry", "regularize", "torchsph")
Rows = list[dict[str, Any]]


def rows_of(files: Iterable[Path]) -> Rows:
    """The rows of JSON documents or of files with one in each line."""
    rows: Rows = []
    for file in files:
        text = file.read_text(encoding="utf-8")
        rows += json.loads(text) if text.lstrip().startswith("[") else [json.loads(line) for line in text.splitlines()]
    return rows


def counted(rows: Rows, by: str) -> dict[str, dict[str, int]]:
    """How many rows ended how, by a column."""
    names = dict.fromkeys(str(row[by]) for row in rows)
    return {name: dict(Counter(row["ended"] for row in rows if str(row[by]) == name)) for name in names}


def abuses(rows: Rows) -> dict[str, Any]:
    """By call and in all, and each one that did harm."""
    harm = [row for row in rows if row["ended"] in ("silent", "obscure", "crash", "hang")]
    told = [f"{row['call']}: {row['argument']} {row['wrong']}: {row['ended']}" for row in harm]
    ended = dict(Counter(row["ended"] for row in rows))
    return {"abuses": len(rows), "all": ended, "by_call": counted(rows, "call"), "harm": told}


def mutants(rows: Rows) -> dict[str, Any]:
    """By mutation."""
    ended = dict(Counter(row["ended"] for row in rows))
    return {"mutants": len(rows), "all": ended, "by_mutation": counted(rows, "mutation")}


def soak(rows: Rows) -> dict[str, Any]:
    """By preset, with the worst volume error of those that finished without a word."""
    kinds: dict[str, dict[str, Any]] = dict(counted(rows, "preset"))
    for name, kind in kinds.items():
        finished = [row for row in rows if row["preset"] == name and row["ended"] == "finished"]
        kind["worst_volume_error"] = round(max((abs(row["volume_error"]) for row in finished), default=0.0), 4)
    return {"scenes": len(rows), "all": dict(Counter(row["ended"] for row in rows)), "by_preset": kinds}


def memory(rows: Rows) -> dict[str, Any]:
    """The runs, as they are."""
    return {"runs": rows}


PARTS = {"abuses": abuses, "mutants": mutants, "soak": soak, "memory": memory}


def main(words: Sequence[str] | None = None) -> int:
    """Write the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    for name in PARTS:
        parser.add_argument(f"--{name}", nargs="+", type=Path, default=[], metavar="FILE", help="what its script wrote")
    parser.add_argument("--json", type=Path, default=TABLE, help="the table")
    args = parser.parse_args(words)
    content = json.loads(args.json.read_text(encoding="utf-8")) if args.json.is_file() else {}
    for name, summed in PARTS.items():
        files = getattr(args, name)
        if files:
            content[name] = summed(rows_of(files)) | {"from": provenance(PACKAGES)}
            print(f"{name}: {content[name].get('all', '')}")
    write_table(args.json, content, PACKAGES)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
