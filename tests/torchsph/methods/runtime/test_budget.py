"""A number of seconds buys the finest particles that fit into it, and the results say which."""

from __future__ import annotations

import json
import time
from types import SimpleNamespace

import numpy as np
import pytest

import geometry
from torchsph.cli import main
from torchsph.methods import budget
from torchsph.methods.budget import BudgetTooSmall, _finest, _longest_share, ensemble_spacing, forecast_spacing
from torchsph.methods.by_name import forecast_skill
from torchsph.simulator.failures import NumericalFailure

LADDER = [4.0, 3.0, 2.0, 1.0, 0.5]


def finest(seconds: float, predicted, tried=None):
    def counted(spacing: float) -> float:
        if tried is not None:
            tried.append(spacing)
        return predicted(spacing)

    return _finest(seconds, time.perf_counter(), LADDER, counted, 1)


def test_the_finest_that_fits_is_taken_and_no_finer_one_is_tried():
    tried: list[float] = []
    found = finest(2000.0, lambda spacing: 1000.0 / spacing**2, tried)
    assert found.spacing == 1.0 and found.seconds == 1000.0 and found.budget == 2000.0
    assert tried == [4.0, 3.0, 2.0, 1.0]  # .5 has four times the particles at least
    assert found.trials == {spacing: 1000.0 / spacing**2 for spacing in tried}
    # the law says that 1 could still fit, and the trial that it does not
    assert finest(2000.0, lambda spacing: 1000.0 * 2.0 ** (4 * (2 - spacing))).spacing == 2.0
    assert finest(1e9, lambda spacing: 1.0).spacing == 0.5


def test_the_trials_are_taken_off_the_budget():
    def slow(spacing: float) -> float:
        time.sleep(0.05)
        return 160.0 / spacing**2

    assert finest(40.05, slow).spacing == 3.0  # the third takes 40 s, and the trials have taken .15
    assert finest(45.0, slow).spacing == 2.0


def test_what_is_too_coarse_for_the_walls_is_passed_over_and_too_little_is_refused_with_what_it_takes():
    def predicted(spacing: float) -> float:
        if spacing > 2.5:
            raise NumericalFailure("no particle fits")
        return 100.0 / spacing

    assert finest(60.0, predicted).spacing == 2.0
    with pytest.raises(BudgetTooSmall, match=r"40 s are not enough: particles of 2e\+03 mm, the coarsest, .* 50 s"):
        finest(40.0, predicted)

    def never(spacing: float) -> float:
        raise ValueError("no room")

    with pytest.raises(ValueError, match="do not fit into these walls"):
        finest(40.0, never)


def test_runs_are_dealt_to_processes_the_longest_first():
    assert _longest_share([8.0, 5.0, 5.0], 1) == 18.0
    assert _longest_share([5.0, 8.0, 5.0], 2) == 10.0
    assert _longest_share([8.0, 5.0, 5.0], 5) == 8.0


@pytest.fixture(name="recording")
def _recording(box_recording):
    return box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=8, times=(0.0, 0.005, 0.01))


def test_a_forecast_writes_what_its_budget_bought(recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(budget, "LADDER", (2.0, 1.6))
    geometry.write_recording(tmp_path / "m.h5", recording)
    call = ["forecast", str(tmp_path / "m.h5"), "--leads", "0.005", "--out", str(tmp_path / "out")]
    assert main([*call, "--budget", "1000"]) == 0
    told = json.loads((tmp_path / "out" / "metrics.json").read_text())["config"]
    assert told["spacing"] == pytest.approx(1.6 * 1.25e-3)
    bought = told["info"]["provenance"]["budget"]
    assert bought["spacing"] == told["spacing"] and bought["budget"] == 1000 and len(bought["trials"]) == 2
    assert f"spacing = {told['spacing']}" in (tmp_path / "out" / "config.toml").read_text()
    capsys.readouterr()
    for more, words in (
        (["--budget", "1e-9"], "s are not enough: particles of 2.5 mm, the coarsest, need about"),
        (["--spacing", "auto"], "--spacing auto needs --budget"),
        (["--spacing", "1e-3", "--budget", "9"], "leave --spacing out, or leave --budget out"),
    ):
        assert main([*call, *more]) == 2
        assert words in capsys.readouterr().err


def test_what_is_foretold_is_what_a_forecast_takes(recording, monkeypatch):
    """Within a factor of two, of processor time: the machine may do other things meanwhile."""
    monkeypatch.setattr(budget, "LADDER", (1.0,))
    monkeypatch.setattr(budget, "clock", SimpleNamespace(perf_counter=time.process_time))
    foretold = forecast_spacing(recording, [0.005], 1e6)
    began = time.process_time()
    forecast_skill(recording, [0.005], spacing=foretold.spacing)
    assert foretold.seconds / 2 < time.process_time() - began < 2 * foretold.seconds


def test_splines_alone_have_no_particles(recording):
    with pytest.raises(ValueError, match="none of the methods has any"):
        ensemble_spacing(recording, 10.0, methods=("spline",))
