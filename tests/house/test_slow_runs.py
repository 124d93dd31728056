"""The script that runs the slow tests in parts goes on where it was, and says what failed."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest
from paths import ROOT

SPECIFICATION = importlib.util.spec_from_file_location("run_slow", ROOT / "tests" / "run_slow.py")
assert SPECIFICATION is not None and SPECIFICATION.loader is not None
run_slow = importlib.util.module_from_spec(SPECIFICATION)
sys.modules["run_slow"] = run_slow  # its dataclass looks for it there
SPECIFICATION.loader.exec_module(run_slow)

SLOW = """
import pytest


@pytest.mark.slow
def test_it():
    with open({log!r}, "a") as log:
        log.write({name!r})
    assert {ends}
"""
CONFIGURATION = '[tool.pytest.ini_options]\naddopts = "-m \'not slow\'"\nmarkers = ["slow: slow"]\n'


@pytest.fixture
def checkout(tmp_path):
    """A repository with two files of slow tests and one without; what runs leaves its letter in a file outside it."""
    root = tmp_path / "checkout"
    (root / "tests").mkdir(parents=True)
    (root / "pyproject.toml").write_text(CONFIGURATION)
    (root / ".gitignore").write_text("__pycache__/\n.pytest_cache/\n")
    for name in "ab":
        (root / "tests" / f"test_{name}.py").write_text(SLOW.format(log=str(tmp_path / "log"), name=name, ends=True))
    (root / "tests" / "test_quick.py").write_text("def test_it():\n    assert False\n")
    git(root, "init", "-q")
    save(root)
    return root


def git(root, *arguments):
    identity = ("-c", "user.name=test", "-c", "user.email=test@localhost")
    subprocess.run(["git", "-C", root, *identity, *arguments], check=True, capture_output=True)


def save(root):
    git(root, "add", "-A")
    git(root, "commit", "-q", "--allow-empty", "-m", "more")


def ran(root):
    log = root.parent / "log"
    return log.read_text() if log.exists() else ""


@pytest.mark.slow
def test_it_goes_on_where_it_was(checkout):
    assert run_slow.main(["tests/test_a.py"], checkout) == 0
    assert ran(checkout) == "a"
    assert run_slow.main([], checkout) == 0
    assert ran(checkout) == "ab"  # the first had passed at this commit
    assert run_slow.main([], checkout) == 0
    assert ran(checkout) == "ab"
    assert run_slow.main(["--again"], checkout) == 0
    assert ran(checkout) == "abab"


@pytest.mark.slow
def test_another_commit_and_a_change_that_is_not_committed_run_all(checkout):
    assert run_slow.main([], checkout) == 0
    save(checkout)
    assert run_slow.main([], checkout) == 0
    assert ran(checkout) == "abab"
    (checkout / "new.py").touch()
    assert run_slow.main([], checkout) == 0
    assert run_slow.main([], checkout) == 0
    assert ran(checkout) == "abababab"


def test_what_failed_is_said_and_written_down(checkout, capsys):
    (checkout / "tests" / "test_b.py").write_text(SLOW.format(log=str(checkout.parent / "log"), name="b", ends=False))
    save(checkout)
    assert run_slow.main([], checkout) == 1
    rows = json.loads((checkout / "tests" / "slow_runs.json").read_text())
    assert [(row["part"], row["outcome"]) for row in rows] == [
        ("tests/test_a.py", "passed"),
        ("tests/test_b.py", "failed"),
    ]
    assert all(row["commit"] and row["started"] and row["seconds"] > 0 for row in rows)
    assert "1 failed" in rows[1]["summary"]
    capsys.readouterr()
    assert run_slow.main(["--list"], checkout) == 0
    assert "failed" in capsys.readouterr().out


def test_it_stops_after_the_minutes_given(checkout):
    assert run_slow.main(["--minutes", "-1"], checkout) == 2
    assert ran(checkout) == ""
