"""`torchsph collect`: the measures of many runs in one table."""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from geometry.recordings.whole_file import write_whole

from ..checks import output_file
from ..command import Command
from ..printing import say
from ..running.small_files import read_small

FIRST = ("item", "state", "method")
LAST = ("seconds", "torchsph", "fingerprint")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("root", metavar="ROOT", help="folder of torchsph batch, or any with results below it")
    parser.add_argument("--out", required=True, metavar="TABLE.csv", help="a row for each item and method")


def collect(args: argparse.Namespace) -> None:
    """`torchsph collect`: a row for each item and method, with what `metrics.json` says of it."""
    path, root = output_file(args.out), Path(args.root)
    if not root.is_dir():
        raise ValueError(f"{root}: is no folder; name the ROOT of torchsph batch")
    begun = {file.parent for name in ("metrics.json", "log.txt") for file in root.rglob(name)}
    folders = sorted(begun | {root / name for name in _listed(root)})
    if not folders:
        raise ValueError(f"{root}: no metrics.json below it; run torchsph batch first")
    rows = [row for folder in folders for row in _rows(folder, folder.relative_to(root).as_posix())]
    measures = list(dict.fromkeys(name for row in rows for name in row if name not in (*FIRST, *LAST)))
    text = io.StringIO()
    writer = csv.DictWriter(text, [*FIRST, *measures, *LAST], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode("utf-8", "backslashreplace"))
    unfinished = [row["item"] for row in rows if row["state"] != "done"]
    if unfinished:
        say(f"without results: {_few(unfinished)}")
    say(f"wrote {len(rows)} rows of {len(folders)} items to {path}")


def _rows(folder: Path, item: str) -> list[dict[str, Any]]:
    """A row for each method of a folder; one that says so where there is none."""
    try:
        document = json.loads(read_small(folder / "metrics.json"))
        methods, seconds, config = document["methods"], document["seconds"], document["config"]
        rows = []
        for name, measures in methods.items():
            row = {"item": item, "state": "done", "method": name, **measures, "seconds": seconds.get(name)}
            row["torchsph"] = config.get("torchsph")
            row["fingerprint"] = config.get("info", {}).get("provenance", {}).get("fingerprint")
            rows.append(row)
    except FileNotFoundError:
        return [{"item": item, "state": "unfinished"}]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return [{"item": item, "state": "damaged"}]
    return rows


def _listed(root: Path) -> list[str]:
    """The items that the last ``torchsph batch`` of all of them has gone through."""
    try:
        items = json.loads(read_small(root / "summary.json"))["items"]
        return [str(item["item"]) for item in items]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


COMMAND = Command("collect", "Gather the measures of many runs in one table.", _arguments, collect)
