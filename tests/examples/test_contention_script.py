"""The script that makes a machine busy leaves nothing behind, and says what failed."""

from __future__ import annotations

import sys

import pytest
from paths import ROOT


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "benchmarks"))
    import contention

    yield contention
    del sys.modules["contention"]


def test_busy_processes_run_inside_the_block_and_end_with_it(script):
    with pytest.raises(ZeroDivisionError), script.busy(2) as spinning:
        assert [process.poll() for process in spinning] == [None, None]
        1 / 0  # noqa: B018
    assert all(process.returncode for process in spinning)


@pytest.mark.slow
def test_a_command_is_timed_and_one_that_fails_is_told(script):
    wall, used = script.run(["--version"], 1, 1, "passive")
    assert wall > 0 and used > 0
    with pytest.raises(RuntimeError, match="no-such-command"):
        script.run(["no-such-command"], 1, 1, "passive")
