"""What a figure leaves beside its picture: numbers, settings and where they come from, and whether they are current."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ..provenance import stale, write_table

SAME = 1e-6  # relative: another order of a sum is no other number


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


def write(
    file: Path, about: dict[str, Any], result: Result, sources: Sequence[str], seconds: float, check: object = None
) -> None:
    """Write the JSON of a figure: it appears whole or not at all.

    ``check``: the numbers of its fast variant, made by the same code (``confirmed``); None where there are none.
    """
    content = about | {
        "settings": result.settings,
        "claims": [asdict(claim) for claim in result.claims],
        "numbers": result.numbers,
        "seconds": round(seconds, 1),
    }
    if check is not None:
        content["check"] = json.loads(json.dumps(check))
    write_table(file, content, sources)


def confirmed(file: Path, check: object) -> bool:
    """Whether later code gives the fast variant's numbers again; then the figure is that code's too, and says so.

    Args:
        file: JSON of a full figure with the fast numbers of the code that made it.
        check: the fast numbers of the present code.
    """
    content = json.loads(file.read_text(encoding="utf-8"))
    if not alike(content.get("check"), json.loads(json.dumps(check))):
        return False
    made = content["from"]
    kept = {"command": made["command"], "numbers of": made.get("numbers of", made["commit"])}
    write_table(file, content, made["sources"], **kept)
    return True


def alike(one: object, other: object) -> bool:
    """Whether two trees of numbers and texts are the same but for the last digits."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(alike(one[name], other[name]) for name in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=SAME) or (math.isnan(one) and math.isnan(other))
    return one == other


def is_current(file: Path, fast: bool) -> bool:
    """Whether a JSON is there that the present code has made, in the same variant."""
    if not file.is_file():
        return False
    content = json.loads(file.read_text(encoding="utf-8"))
    return content.get("fast") == fast and not stale(content)
