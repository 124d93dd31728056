"""`--spacing auto` and `--budget`: the options, and what they come to."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torchsph.methods.budget import Afforded
from torchsph.methods.runtime.parallel import under_torchrun

from .arguments import AUTO
from .outputs import write_json
from .printing import say
from .running.small_files import read_small

# beside the checkpoint of a run that chose its spacing, which goes on with the same
NAME = "spacing.json"


def chosen_spacing(
    args: argparse.Namespace, choose: Callable[[float], Afforded], kept: Path | None = None
) -> dict[str, Any] | None:
    """What the budget buys, for the account of the run; ``args`` holds the spacing itself from here on.

    Args:
        args: options of the command.
        choose: by a budget in seconds.
        kept: the file in which a run that goes on from a checkpoint finds what was chosen at its beginning, or None.

    Raises:
        ValueError: one of the options means nothing without the other, or the budget is too small.
    """
    if args.budget is None and args.spacing != AUTO:
        return None
    if args.budget is None:
        raise ValueError("--spacing auto needs --budget SECONDS, by which it is chosen")
    if args.spacing not in (None, AUTO):
        raise ValueError("--budget chooses the spacing: leave --spacing out, or leave --budget out")
    if under_torchrun():
        raise ValueError("--budget is for one machine: give --spacing under torchrun")
    found: dict[str, Any]
    if kept is not None and kept.is_file():
        found = _kept(kept)
    else:
        found = asdict(choose(args.budget))
        found["trials"] = [{"spacing": one, "seconds": seconds} for one, seconds in found["trials"].items()]
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_json(kept, found)
    args.spacing, args.budget = found["spacing"], None
    say(
        f"particles of {1e3 * found['spacing']:.3g} mm: about {found['seconds']:.3g} s of the {found['budget']:g} given"
    )
    return found


def _kept(path: Path) -> dict[str, Any]:
    """The choice of the run that this one goes on with.

    Raises:
        ValueError: the file does not say it.
    """
    content = read_small(path)
    try:
        found = dict(json.loads(content))
        for name in ("spacing", "seconds", "budget"):
            found[name] = float(found[name])
    except (ValueError, TypeError, KeyError, RecursionError) as fault:
        raise ValueError(f"{path}: does not say which spacing was chosen; remove it to choose again") from fault
    return found
