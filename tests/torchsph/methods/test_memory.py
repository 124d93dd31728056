"""Memory is foretold and refused with a cure; what is free is the least of machine and control group."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import geometry
from torchsph import PreparedMeasurement, run_methods
from torchsph.cli import main
from torchsph.cli.commands import smooth
from torchsph.methods import by_name
from torchsph.methods.memory import MemoryPrediction, NotEnoughMemory, _control_group, free_memory
from torchsph.methods.models import Models

GB = 10**9


@pytest.fixture(name="measured")
def _measured(box_recording: Callable[..., geometry.Recording]) -> geometry.Recording:
    return box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=8, times=(0.0, 0.01))


def test_what_does_not_fit_is_refused_before_any_work_with_the_setting_to_change(measured, monkeypatch):
    with pytest.raises(NotEnoughMemory, match=r"needs about [\d.e+]+ GB .*are free; try a larger --spacing"):
        run_methods(measured, ("ensemble",), spacing=2e-6)
    monkeypatch.setattr(by_name, "free_memory", lambda: 10**6)
    with pytest.raises(NotEnoughMemory, match=r"only 1 MB are free"):
        run_methods(measured, ("spline",))


def test_forecasts_and_splines_are_foretold_as_well(measured, tmp_path, monkeypatch, capsys):
    with pytest.raises(NotEnoughMemory, match=r"needs about [\d.e+]+ GB .*try a larger --spacing"):
        by_name.forecast_skill(measured, [0.01], spacing=2e-6)
    plain, saved = (by_name.predicted_forecast_memory(measured, leads) for leads in ((), (0.01,)))
    assert saved.recordings - plain.recordings == 2 * measured.velocity.astype(np.float32).nbytes
    assert plain.splines == plain.members == 0 < plain.tables
    path, out = tmp_path / "m.h5", tmp_path / "out.h5"
    geometry.write_recording(path, measured)
    for module in (by_name, smooth):
        monkeypatch.setattr(module, "free_memory", lambda: 10**6)
    for call in (
        ["smooth", str(path), "--out", str(out)],
        ["forecast", str(path), "--out", str(out), "--leads", "0.01"],
    ):
        assert main(call) == 3
        assert f"{call[0]}: error: {path}: needs about" in capsys.readouterr().err and not out.exists()


def test_the_largest_part_names_the_cure():
    def cure(**parts: int) -> str:
        sizes = dict.fromkeys(("splines", "particles", "tables", "members", "recordings"), 1) | parts
        with pytest.raises(MemoryError) as told:
            MemoryPrediction(**sizes).refuse_beyond(2 * GB)
        return str(told.value).rpartition("; ")[2]

    assert cure(members=3 * GB) == "try fewer --members"
    assert cure(tables=3 * GB) == cure(particles=3 * GB) == "try a larger --spacing"
    assert "coarser grid" in cure(splines=3 * GB) and "fewer frames" in cure(recordings=3 * GB)
    MemoryPrediction(1, 1, 1, 1, 1).refuse_beyond(None)
    MemoryPrediction(1, 1, 1, 1, 1).refuse_beyond(GB)


def test_every_setting_counts_as_it_should(measured):
    prepared = PreparedMeasurement(measured)

    def of(methods=("ensemble",), **more):
        return by_name.predicted_memory(prepared, methods, **more)

    alone, plain = of(("spline",)), of(spacing=2e-3)
    assert alone.particles == alone.tables == alone.members == 0 and alone.splines == plain.splines > 0
    free = of(("free",), spacing=2e-3)  # its splines are done before its particles are made: the larger of both
    assert free.total - alone.total == max(0, free.particles + free.tables - free.splines)
    valves = replace(measured, valve_intervals=np.array([[1.0, 0.0, 0.004]]))
    assert by_name.predicted_memory(PreparedMeasurement(valves), ("free",), spacing=2e-3).tables > free.tables
    assert of(spacing=2e-3, members=32).members == 2 * plain.members
    assert of(spacing=1e-3).particles == pytest.approx(8 * plain.particles, rel=1e-3)  # counts of whole particles
    assert of(spacing=1e-3).tables > 2 * plain.tables
    control = of(spacing=2e-3, control_spacing=1e-3)
    assert (control.particles, control.tables) == (plain.particles, plain.tables)  # half of the members' already
    assert of(spacing=2e-3, control_spacing=5e-4).tables > plain.tables
    assert Models(prepared, "default", 2e-3, "cpu", 7e-4).anew().fine.scene.spacing == 7e-4
    assert of(spacing=2e-3, also=[measured]).recordings > plain.recordings


def test_a_control_group_counts_with_all_groups_above_it(tmp_path: Path):
    own = tmp_path / "cgroup"
    own.write_text("0::/job/step\n")
    for folder, most, used, cache in (("job", 5 * GB, 2 * GB, GB), ("job/step", "max", GB, 0)):
        group = tmp_path / folder
        group.mkdir(exist_ok=True)
        for name, value in (("memory.max", most), ("memory.current", used), ("memory.stat", f"inactive_file {cache}")):
            (group / name).write_text(f"{value}\n")
    assert _control_group(tmp_path, own) == 4 * GB
    (tmp_path / "job" / "step" / "memory.max").write_text(f"{GB}\n")
    assert _control_group(tmp_path, own) == 0
    own.write_text("7:cpu,memory:/old\n")
    (tmp_path / "memory" / "old").mkdir(parents=True)
    for name, value in (
        ("memory.limit_in_bytes", 3 * GB),
        ("memory.usage_in_bytes", GB),
        ("memory.stat", "cache 1\ntotal_inactive_file 7"),
    ):
        (tmp_path / "memory" / "old" / name).write_text(f"{value}\n")
    assert _control_group(tmp_path, own) == 2 * GB + 7
    assert _control_group(tmp_path, tmp_path / "gone") is None
    assert 10**7 < free_memory() < 10**14


def test_what_splines_give_back_is_used_again():
    def total(**more: int) -> int:
        return MemoryPrediction(splines=300, particles=50, tables=100, members=1, recordings=2, **more).total

    assert total() - total(released=80) == 80 and total() - total(released=10**9) == 150  # no more than is needed later
