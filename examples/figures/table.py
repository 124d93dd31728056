"""The page of the figures, written from their JSONs: what was observed, whether it is seen here, and the numbers."""

from __future__ import annotations

import json
from pathlib import Path

from .registry import FIGURES

HEAD = """# The experiments of Grønli 2017, run again

Written by `python -m examples.figures` from the JSON of each figure, which holds all numbers, settings and where they
come from. "Not seen" is no fault of either side by itself: the number says what is so here.
"""


def page(results: Path) -> str:
    """The page for what is in a folder of results."""
    parts = [HEAD]
    for name, entry in FIGURES.items():
        file = results / f"{name}.json"
        if not file.is_file():
            continue
        content = json.loads(file.read_text(encoding="utf-8"))
        parts.append(f"## {entry.title[0].upper()}{entry.title[1:]}\n")
        fast = " The fast variant, coarse and short, on the sample recording." if content["fast"] else ""
        parts.append(f"Grønli 2017, {entry.thesis}; {content['seconds']:.0f} s.{fast}\n")
        parts.append(f"![{entry.title}](results/{name}.png)\n")
        parts.append("| observed then | here | number |\n|---|---|---|")
        for claim in content["claims"]:
            seen = "seen" if claim["seen_here"] else "not seen"
            parts.append(f"| {claim['observed_in_thesis']} | {seen} | {claim['number']} |")
        parts.append("")
    return "\n".join(parts).rstrip("\n") + "\n"
