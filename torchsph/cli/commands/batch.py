"""`torchsph batch`: one method set on many recordings, each in a process of its own."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import geometry

from ..arguments import Parser, number, whole
from ..command import Command
from ..exit_codes import ExitCode
from ..outputs import output_folder, write_json
from ..printing import print_table, say
from ..running.child import Outcome, run_child
from ..running.folder_lock import swept
from ..running.isolated import SECONDS_TO_READ, isolated, memory_to_read
from ..running.items import Item, listed
from ..running.provenance import fingerprint, input_digests
from ..running.settings import as_arguments
from ..running.small_files import read_small
from . import assimilate

DONE, BEFORE, FAILED, STOPPED = "done", "done before", "failed", "stopped"


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("inputs", nargs="+", metavar="LIST|GLOB", help="a list of recordings, a pattern, or recordings")
    parser.add_argument("--out", required=True, metavar="ROOT", help="folder with a folder of results for each")
    parser.add_argument("--index", type=whole(0), metavar="N", help="run the N-th alone, from 0: for array jobs")
    parser.add_argument("--again", action="store_true", help="run those as well that are done")
    parser.add_argument(
        "--time-limit", type=number(0, open_below=True), metavar="S", help="seconds, after which an item is given up"
    )
    assimilate.add_method_options(parser)


def batch(args: argparse.Namespace) -> int:
    """`torchsph batch`: `assimilate` for each recording; a failed one costs itself alone."""
    root = output_folder(args.out)
    items = listed(args.inputs, root)
    if args.index is not None:
        if args.index >= len(items):
            raise ValueError(
                f"--index: there are {len(items)} recordings, counted from 0; {args.index} is none of them"
            )
        outcome, state = _run(items[args.index], args)
        _tell(items[args.index], outcome, state)
        return int(outcome.code)
    results: list[tuple[Item, Outcome, str]] = []
    for number_, item in enumerate(items, 1):
        say(f"{number_} of {len(items)}: {item.source}")
        outcome, state = _run(item, args)
        _tell(item, outcome, state)
        results.append((item, outcome, state))
    _summary(root, results)
    return _code([outcome.code for _, outcome, _ in results])


def _run(item: Item, args: argparse.Namespace) -> tuple[Outcome, str]:
    """Run one item where it is not done yet; whatever is wrong with it is its outcome."""
    try:
        if not item.source.is_file():
            raise FileNotFoundError(f"{item.source}: there is no such file")
        line, parser = _line(item, args), _parser()
        asked = parser.parse_args(line[1:])
        asked.command = assimilate.COMMAND.name
        known = fingerprint(asked, input_digests({"measurement": item.source}))
        if not args.again and _finished(item.folder) == known:
            return Outcome(ExitCode.DONE, 0.0), BEFORE
        _read_apart(item.source)
        item.folder.mkdir(parents=True, exist_ok=True)
        if (item.folder / "checkpoint.pt").exists():
            line.append("--resume")
        outcome = run_child(line, item.folder / "log.txt", args.time_limit)
        swept(item.folder)
    except (ValueError, OSError) as fault:
        return Outcome(ExitCode.INPUT, 0.0, str(fault)), FAILED
    except MemoryError as fault:
        return Outcome(ExitCode.MEMORY, 0.0, str(fault) or "out of memory while it was read"), FAILED
    states = {ExitCode.DONE: DONE, ExitCode.RESUME: STOPPED}
    return outcome, states.get(ExitCode(outcome.code) if outcome.code in set(ExitCode) else ExitCode.OURS, FAILED)


def _line(item: Item, args: argparse.Namespace) -> list[str]:
    """The command line of an item."""
    passed = {name: value for name, value in vars(args).items() if name not in ("out", "command", "run", "config")}
    own = ["--out", str(item.folder), "--status", str(item.folder / "status.jsonl")]
    return [assimilate.COMMAND.name, str(item.source), *own, *as_arguments(_parser(), passed)]


def _parser() -> Parser:
    parser = Parser(prog="torchsph assimilate")
    assimilate.COMMAND.arguments(parser)
    return parser


def _finished(folder: Path) -> str | None:
    """The fingerprint of the results in a folder; None where they are not complete."""
    if not (folder / "analysis.h5").is_file():
        return None
    try:
        document = json.loads(read_small(folder / "metrics.json"))
        return str(document["config"]["info"]["provenance"]["fingerprint"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):  # an older version's, or half a copy
        return None


def _read_apart(source: Path) -> None:
    """Refuse a recording whose reading fails, hangs or crashes, at the cost of a fork."""
    memory = memory_to_read(source)
    isolated(lambda: bool(geometry.read_recording(source)), str(source), seconds=SECONDS_TO_READ, memory=memory)


def _tell(item: Item, outcome: Outcome, state: str) -> None:
    if state == FAILED:
        say(f"{item.name}: failed with code {outcome.code}: {outcome.message}")
    else:
        say(f"{item.name}: {state}" + (f" in {outcome.seconds:.0f} s" if state == DONE else ""))


def _summary(root: Path, results: Sequence[tuple[Item, Outcome, str]]) -> None:
    """Print and write how each item ended."""
    rows = [["item", "state", "code", "seconds", "message"]]
    rows += [[i.name, state, str(int(o.code)), f"{o.seconds:.0f}", o.message] for i, o, state in results]
    print_table(rows, text=True)
    named = [dict(zip(rows[0], row, strict=True)) for row in rows[1:]]
    root.mkdir(parents=True, exist_ok=True)
    write_json(root / "summary.json", {"items": named})
    failed = sum(1 for _, _, state in results if state == FAILED)
    say(f"{len(results) - failed} of {len(results)} are done; summary.json in {root}/")


def _code(codes: Sequence[int]) -> int:
    """0 where all went well; the code that all failures share, else 1."""
    failures = {int(code) for code in codes} - {int(ExitCode.DONE)}
    return int(ExitCode.OURS) if len(failures) > 1 else next(iter(failures), int(ExitCode.DONE))


COMMAND = Command(
    "batch",
    """Run assimilate on many recordings, each in a process of its own.

    Goes on after a failed one; what is done already is not done again, what was interrupted goes on. The exit code
    is that of the failures where they share one, else 1.""",
    _arguments,
    batch,
)
