"""The script for a GPU runs all its parts on a CPU, and goes on after parts that fail or hang."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from paths import ROOT

SCRIPT = ROOT / "examples" / "benchmarks" / "gpu.py"


def run(out, *arguments):
    command = [sys.executable, SCRIPT, "--device", "cpu", "--fast", "--out", out, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads((out / "gpu.json").read_text()), done.stdout


@pytest.fixture
def script(monkeypatch):
    """The script as a module, with the parts as it would import them."""
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    import gpu

    yield gpu
    for name in [name for name in sys.modules if name == "gpu" or name.startswith("gpu_parts")]:
        del sys.modules[name]


def test_the_limits_of_all_parts_stay_below_eight_minutes(script):
    from gpu_parts import PARTS

    assert set(script.LIMITS) == set(PARTS) and sum(script.LIMITS.values()) < 8 * 60


@pytest.mark.slow
def test_a_part_leaves_rows_with_numbers_and_the_table_names_the_machine(tmp_path):
    report, shown = run(tmp_path, "--parts", "machine", "pairs")
    assert [report[name]["ended"] for name in ("machine", "pairs")] == ["done", "done"]
    assert not [row for part in report.values() for row in part["rows"] if "error" in row]
    rates = [row["g_pairs_per_s"] for row in report["pairs"]["rows"] if "g_pairs_per_s" in row]
    assert len(rates) == 4 and min(rates) > 0
    assert {round(row["mean_neighbours"], -1) for row in report["pairs"]["rows"] if "mean_neighbours" in row} == {
        60,
        260,
    }
    assert report["machine"]["rows"][0]["device"] in shown and (tmp_path / "gpu.png").stat().st_size > 1000


def test_what_was_measured_before_a_part_hangs_or_dies_is_kept(script, tmp_path):
    path = tmp_path / "rows"
    path.write_text('{"a": 1}\n{"a": 2}\n{"a": ')
    assert script.read_rows(path) == [{"a": 1}, {"a": 2}] and script.read_rows(tmp_path / "none") == []


@pytest.mark.slow
def test_a_part_that_takes_too_long_is_stopped_and_the_next_one_runs(tmp_path):
    report, _ = run(tmp_path, "--parts", "steps", "machine", "--seconds", "2")
    assert "stopped after its 2 s" in report["steps"]["ended"] and "left out" in report["machine"]["ended"]


def test_a_failure_inside_a_part_becomes_a_row_and_the_part_goes_on(script, tmp_path):
    from gpu_parts.bench import Bench

    with (tmp_path / "rows").open("w") as rows:
        bench = Bench("cpu", True, tmp_path / "none", rows)
        with bench.attempt(size=3):
            raise ValueError("what went wrong\nin detail")
        bench.add(size=4)
    assert script.read_rows(tmp_path / "rows") == [{"size": 3, "error": "ValueError: what went wrong"}, {"size": 4}]


@pytest.mark.slow  # a minute on a machine that is free
def test_every_part_runs_tiny_on_the_cpu(tmp_path):
    report, _ = run(tmp_path)
    assert {name: part["ended"] for name, part in report.items()} == dict.fromkeys(report, "done")
    assert len(report) == 8 and not [row for part in report.values() for row in part["rows"] if "error" in row]
    assert all(part["rows"] for part in report.values())
    spent = [row["real_time_s"] for row in report["cycle"]["rows"]]
    assert spent and report["tests"]["rows"][0]["passed"] > 0
