"""Run the slow tests in parts, one file after the other, and write down what ran when.

    python tests/run_slow.py [PATH ...] [--minutes N] [--again] [--list]

A part is the slow tests of one file. What ran is kept in `tests/slow_runs.json`: the commit, when it started, how many
seconds it took and how it ended. A part that passed at this commit is not run again, so that a run that was cut off, or
that was told to stop after N minutes, goes on where it was; a change that is not committed makes every part run. Exit
code 0 says that all parts asked for have passed at this commit, 1 that one failed, 2 that some are left.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RECORD = Path("tests") / "slow_runs.json"
OUTCOMES = {0: "passed", 1: "failed", 2: "interrupted", 5: "nothing to run"}


@dataclass(frozen=True)
class Run:
    """How the slow tests of a file went.

    Args:
        part: the file.
        commit: what was checked out; a plus sign behind it tells of changes that were not committed.
        started: when, UTC.
        seconds: how long it took.
        outcome: passed, failed, interrupted, or an exit code of pytest.
        summary: pytest's last line.
    """

    part: str
    commit: str
    started: str
    seconds: float
    outcome: str
    summary: str


def commit(root: Path) -> str:
    """What is checked out, with a plus sign where something but the record of runs differs from it."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True, check=True).stdout

    changed = [line for line in git("status", "--porcelain").splitlines() if line[3:] != RECORD.as_posix()]
    return git("rev-parse", "--short=10", "HEAD").strip() + ("+" if changed else "")


def parts(root: Path, paths: Sequence[str]) -> list[str]:
    """Files with slow tests below some paths. RuntimeError where pytest cannot collect them."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "slow", *paths]
    found = subprocess.run(command, cwd=root, capture_output=True, text=True)
    if found.returncode not in (0, 5):
        raise RuntimeError(f"pytest cannot collect the slow tests:\n{found.stdout}{found.stderr}")
    return sorted({line.split("::")[0] for line in found.stdout.splitlines() if "::" in line})


def run(root: Path, part: str, checked_out: str) -> Run:
    """Run the slow tests of a file; what they print goes to the terminal."""
    started, clock = datetime.now(UTC), time.perf_counter()
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "slow", part]
    lines = []
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            lines.append(line.strip())
    summary = next((line.strip("= ") for line in reversed(lines) if line), "")
    code = process.returncode
    return Run(
        part,
        checked_out,
        started.isoformat(timespec="seconds"),
        round(time.perf_counter() - clock, 1),
        OUTCOMES.get(code, f"exit code {code}"),
        summary,
    )


def read(root: Path) -> dict[str, Run]:
    """The last run of each part."""
    file = root / RECORD
    return {row["part"]: Run(**row) for row in json.loads(file.read_text())} if file.is_file() else {}


def write(root: Path, runs: dict[str, Run]) -> None:
    """Keep the last run of each part; a file half written is never seen."""
    file = root / RECORD
    staged = file.with_suffix(".json.new")
    staged.write_text(json.dumps([asdict(runs[part]) for part in sorted(runs)], indent=1) + "\n")
    staged.replace(file)


def table(runs: Sequence[Run]) -> str:
    """The runs as lines of text."""
    width = max((len(run.part) for run in runs), default=0)
    return "\n".join(
        f"{run.part:<{width}}  {run.commit:<11}  {run.started}  {run.seconds:8.1f} s  {run.outcome}" for run in runs
    )


def main(arguments: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """Run what is left; see the module's text for the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("paths", nargs="*", default=["tests"], metavar="PATH", help="files or folders (default: tests)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="start no further part after so long")
    parser.add_argument("--again", action="store_true", help="also run what has passed at this commit")
    parser.add_argument("--list", action="store_true", help="show what ran when, and run nothing")
    options = parser.parse_args(arguments)
    runs = read(root)
    if options.list:
        print(table([runs[part] for part in sorted(runs)]))
        return 0
    checked_out, asked, began = commit(root), parts(root, options.paths), time.perf_counter()

    def passed(part: str) -> bool:
        last = runs.get(part)
        return last is not None and last.outcome == "passed" and last.commit == checked_out and "+" not in checked_out

    todo = [part for part in asked if options.again or not passed(part)]
    done: list[Run] = []
    for number, part in enumerate(todo, 1):
        if time.perf_counter() - began > 60 * options.minutes:
            break
        print(f"[{number}/{len(todo)}] {part}", flush=True)
        done.append(run(root, part, checked_out))
        runs[part] = done[-1]
        write(root, runs)
    print(table(done))
    if any(run.outcome != "passed" for run in done):
        return 1
    left = len(todo) - len(done)
    print(f"{len(asked) - left} of {len(asked)} parts have passed at {checked_out}")
    return 2 if left else 0


if __name__ == "__main__":
    sys.exit(main())
