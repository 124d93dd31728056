"""What a figure leaves beside its picture: numbers, settings and where they come from, and whether they are current."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ..provenance import stale, write_table


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


def write(file: Path, about: dict[str, Any], result: Result, sources: Sequence[str], seconds: float) -> None:
    """Write the JSON of a figure: it appears whole or not at all."""
    content = about | {
        "settings": result.settings,
        "claims": [asdict(claim) for claim in result.claims],
        "numbers": result.numbers,
        "seconds": round(seconds, 1),
    }
    write_table(file, content, sources)


def is_current(file: Path, fast: bool) -> bool:
    """Whether a JSON is there that the present code has made, in the same variant."""
    if not file.is_file():
        return False
    content = json.loads(file.read_text(encoding="utf-8"))
    return content.get("fast") == fast and not stale(content)
