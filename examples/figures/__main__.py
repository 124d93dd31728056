"""Run figures by name; see the package's text."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from ..provenance import ROOT, code_hash
from . import __doc__ as about
from .material import Material
from .record import Claim, confirmed, is_current, write
from .registry import FIGURES, Entry
from .style import save
from .table import page

RESULTS = ROOT / "examples" / "figures" / "results"


def draw(entry: Entry, material: Material, out: Path) -> list[Claim]:
    """Make one figure; its JSON is written last, so that a figure that has one is whole."""
    began = time.perf_counter()
    material.begin(entry.name, code_hash(entry.sources))
    result = entry.make(material)
    save(result.draw(), out / f"{entry.name}.png")
    heading = {"figure": entry.name, "title": entry.title, "thesis": f"Grønli 2017, {entry.thesis}"}
    heading |= {"fast": material.fast}
    passed = time.perf_counter() - began
    check = None if material.fast or entry.timed else quickly(entry, material.seed)
    write(out / f"{entry.name}.json", heading, result, entry.sources, passed, check)
    return result.claims


def quickly(entry: Entry, seed: int) -> dict[str, Any]:
    """The numbers of the fast variant: what later code is held against (``record.confirmed``)."""
    return entry.make(Material(fast=True, seed=seed)).numbers


def main(arguments: list[str] | None = None) -> int:
    """Draw what was asked for and is not current."""
    parser = argparse.ArgumentParser(prog="python -m examples.figures", description=(about or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=["all"], metavar="NAME", help=f"all, {', '.join(FIGURES)}")
    parser.add_argument("--fast", action="store_true", help="coarse and short, on the sample that ships: seconds each")
    parser.add_argument("--again", action="store_true", help="also what is current")
    parser.add_argument(
        "--confirm",
        action="store_true",
        help="draw nothing: full figures whose fast variants come out as they did are current again",
    )
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder")
    parser.add_argument("--data", type=Path, default=Material().data, help="folder of the phantom")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1, help="of torch (default 1)")
    options = parser.parse_args(arguments)
    names = list(FIGURES) if "all" in options.names else options.names
    unknown = [name for name in names if name not in FIGURES]
    if unknown:
        parser.error(f"unknown figure '{unknown[0]}'; known: all, {', '.join(FIGURES)}")
    torch.set_num_threads(options.threads)
    options.out.mkdir(parents=True, exist_ok=True)
    material = Material(options.fast, options.seed, options.data, options.out / "kept")
    bar = tqdm(names, desc="figures", unit="figure", disable=None)
    for name in bar:
        bar.set_postfix_str(name)
        if not options.again and current(options.out / f"{name}.json", options.fast):
            tqdm.write(f"{name}: current", file=sys.stderr)
            continue
        if options.confirm:
            tqdm.write(f"{name}: {confirm(FIGURES[name], options.out, options.seed)}", file=sys.stderr)
            continue
        for claim in draw(FIGURES[name], material, options.out):
            tqdm.write(f"{name}: {'seen' if claim.seen_here else 'not seen'}: {claim.number}", file=sys.stderr)
    if options.out == RESULTS:
        (options.out.parent / "README.md").write_text(page(options.out), encoding="utf-8")
    return 0


def confirm(entry: Entry, out: Path, seed: int) -> str:
    """What has come of holding the present code's fast variant against that of the code that drew a figure."""
    file = out / f"{entry.name}.json"
    content = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if content.get("check") is None:
        return "nothing to hold it against; draw it again"
    return "the same numbers" if confirmed(file, quickly(entry, seed)) else "other numbers; draw it again"


def current(file: Path, fast: bool) -> bool:
    """Whether a figure need not be drawn: the present code has drawn it, and a fast one takes no full one's place."""
    return is_current(file, fast) or (fast and is_current(file, fast=False))


if __name__ == "__main__":
    raise SystemExit(main())
