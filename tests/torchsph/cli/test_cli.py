"""The command line as its users meet it: files, tables, exit codes, one line for each fault."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import geometry
import regularize
import torchsph as torchsph_package
from torchsph import cli, data
from torchsph.evaluation import figures as report
from torchsph.evaluation import metrics
from torchsph.methods import by_name as pipeline
from torchsph.methods.runtime.watching import Stopped

QUICK = ("--spacing", "3e-3")
PACKAGES = Path(geometry.__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, str]:
    """Three measured frames of the sample, their truth, and files that are at fault."""
    folder = tmp_path_factory.mktemp("recordings")
    measured = geometry.read_recording(data.sample_measurement()).select(slice(11, 14))
    truth = geometry.read_recording(data.sample_truth())
    recordings = {
        "measured": measured,
        "truth": truth.select((truth.time > measured.time[0] - 1e-6) & (truth.time < measured.time[-1] + 1e-6)),
        "late_truth": truth.select(truth.time > measured.time[0] + 1e-6),
        "coarse_truth": coarser(truth),
    }
    for name, recording in recordings.items():
        geometry.write_recording(folder / f"{name}.h5", recording)
    (folder / "text.h5").write_text("no recording")
    return {path.stem: str(path) for path in folder.iterdir()}


def coarser(recording: geometry.Recording) -> geometry.Recording:
    """Every second node: a grid that no other recording here shares."""
    from dataclasses import replace

    grid = recording.grid
    shape = tuple(len(range(0, n, 2)) for n in grid.shape)
    return replace(
        recording,
        grid=geometry.Grid(grid.origin, tuple(2 * s for s in grid.spacing), shape),
        velocity=recording.velocity[..., ::2, ::2, ::2],
        mask=recording.mask[:, ::2, ::2, ::2],
    )


def torchsph(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    """`torchsph ...` in a process of its own, with the packages under test."""
    path = os.pathsep.join([str(PACKAGES), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, "-m", "torchsph", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        timeout=300,
    )


def rows(table: str) -> dict[str, list[str]]:
    """Rows of a printed table by their first column."""
    return {line.split()[0]: line.split()[1:] for line in table.strip().splitlines()}


# --- commands that end well ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def assimilated(files, tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess]:
    folder = tmp_path_factory.mktemp("assimilate")
    methods = ",".join(pipeline.METHODS)
    done = torchsph(
        "assimilate",
        files["measured"],
        "--truth",
        files["truth"],
        "--method",
        methods,
        *QUICK,
        "--members",
        "3",
        "--keep-members",
        "--out",
        "out",
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return folder / "out", done


def test_assimilate_writes_what_it_promises(assimilated, files):
    folder, done = assimilated
    analyses = {f"{name}.h5" for name in pipeline.METHODS}
    views = {f"{name}{end}.vtkhdf" for name in (*pipeline.METHODS, "analysis") for end in ("", "_wall")}
    assert max((folder / name).stat().st_size for name in views) < 100_000  # they hold no copy
    assert {path.name for path in folder.iterdir()} == analyses | views | {
        "analysis.h5",
        "report.png",
        "report.html",
        "filter.png",
        "metrics.json",
        "config.toml",
        "quantities.json",
        "quantities.csv",
        "members.h5",
    }
    measured = geometry.read_recording(files["measured"])
    for name in (*analyses, "analysis.h5"):
        analysis = geometry.read_recording(folder / name)
        assert analysis.grid == measured.grid
        np.testing.assert_array_equal(analysis.time, measured.time)
        np.testing.assert_array_equal(analysis.mask, measured.mask)
    assert (folder / "analysis.h5").read_bytes() == (folder / f"{pipeline.DEFAULT_METHOD}.h5").read_bytes()
    assert list(rows(done.stdout))[: 2 + len(pipeline.METHODS)] == ["method", "raw", *pipeline.METHODS]


def test_assimilate_reads_quantities_out_of_every_member(assimilated, files, tmp_path):
    folder, done = assimilated
    document = json.loads((folder / "quantities.json").read_text())
    bands = document["members"]["curves"]["pressure_difference"]
    assert all(low < mean < high for low, mean, high in zip(*(bands[k] for k in ("low", "mean", "high")), strict=True))
    assert set(document["curves"]) == {"analysis", "truth"} and "kinetic_energy" in document["members"]["coverage"]
    analysis = geometry.read_recording(folder / "analysis.h5")
    inside = np.asarray(analysis.mask, bool)
    assert np.isfinite(analysis.pressure[inside]).all() and (analysis.pressure_sigma[inside] > 0).mean() > 0.9
    assert "pressure_difference_highest" in rows(done.stdout)
    again = [
        "quantify",
        str(folder / "analysis.h5"),
        "--members",
        str(folder / "members.h5"),
        "--truth",
        files["truth"],
    ]
    assert cli.main([*again, "--out", str(tmp_path)]) == 0
    kept = json.loads((tmp_path / "quantities.json").read_text())["members"]["curves"]["kinetic_energy"]["mean"]
    np.testing.assert_allclose(kept, document["members"]["curves"]["kinetic_energy"]["mean"], rtol=1e-3)
    assert "members kinetic_energy low [J]" in (folder / "quantities.csv").read_text().splitlines()[0]


@pytest.mark.slow  # half a minute
def test_quantities_of_splines_have_bands_where_they_are_asked_for(files, tmp_path):
    arguments = ["assimilate", files["measured"], "--method", "spline", "--members", "4", "--quantities"]
    assert cli.main([*arguments, "--out", str(tmp_path)]) == 0
    document = json.loads((tmp_path / "quantities.json").read_text())
    assert min(document["members"]["curves"]["kinetic_energy"]["deviation"]) > 0
    assert geometry.read_recording(tmp_path / "analysis.h5").pressure_sigma is not None


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--method", "spline", "--keep-members"], "--keep-members: only the ensemble has members"),
        (["--keep-members", "--lag", "2"], "with --lag they change"),
        (["--quantities", "--no-quantities"], "cannot be together"),
    ],
)
def test_options_of_quantities_that_cannot_be(options, told, files, tmp_path, capsys):
    assert cli.main(["assimilate", files["measured"], *options, "--out", str(tmp_path / "out")]) == 2
    assert told in capsys.readouterr().err


def test_assimilate_reports_the_errors_of_the_files_it_wrote(assimilated, files):
    folder, done = assimilated
    document = json.loads((folder / "metrics.json").read_text())
    assert set(document) == {"methods", "per_frame", "seconds", "config"}
    assert list(document["methods"]) == ["raw", *pipeline.METHODS]
    assert set(document["seconds"]) == set(pipeline.METHODS)
    measured, truth = (geometry.read_recording(files[name]) for name in ("measured", "truth"))
    true = truth.velocity[::2]
    size = np.sqrt(np.mean(np.sum(true.astype(float) ** 2, 1)[measured.mask]))
    for name in document["methods"]:
        velocity = measured.velocity if name == "raw" else geometry.read_recording(folder / f"{name}.h5").velocity
        error = np.sqrt(np.mean(np.sum((velocity - true).astype(float) ** 2, 1)[measured.mask]))
        scores = document["methods"][name]
        assert set(scores) == set(metrics.METRICS)
        assert scores["nrmse"] == pytest.approx(error / size, rel=1e-5)
        assert float(rows(done.stdout)[name][0]) == pytest.approx(error / size, rel=1e-2)
        assert len(document["per_frame"][name]["nrmse"]) == measured.frames
    config = document["config"]
    assert config["members"] == 3 and config["spacing"] == 3e-3 and config["preset"] == "default"


def test_assimilate_draws_a_picture(assimilated):
    image = matplotlib.image.imread(assimilated[0] / "report.png")
    assert image.shape[0] > 600 and image.shape[1] > 600 and image[..., :3].std() > 0.1


@pytest.mark.slow
def test_assimilate_alone_runs_the_default_method_without_a_truth(files, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    arguments = ["assimilate", files["measured"], *QUICK, "--members", "3", "--out", str(out)]
    assert cli.main(arguments) == 0
    document = json.loads((out / "metrics.json").read_text())
    assert list(document["methods"]) == ["raw", "free", pipeline.DEFAULT_METHOD]
    assert "nrmse" not in document["methods"]["raw"] and document["methods"]["raw"]["residual_rms"] == 0
    printed = list(rows(capsys.readouterr().out))
    assert printed[:5] == ["method", "raw", "free", pipeline.DEFAULT_METHOD, "quantity"]
    assert "kinetic_energy" in printed


def test_one_asked_method_becomes_the_analysis(files, tmp_path):
    arguments = ["assimilate", files["measured"], "--method", "spline", "--out", str(tmp_path)]
    assert cli.main(arguments) == 0
    assert (tmp_path / "analysis.h5").read_bytes() == (tmp_path / "spline.h5").read_bytes()


def test_another_method_leaves_the_checkpoint_of_an_ensemble(files, tmp_path):
    (tmp_path / "checkpoint.pt").write_text("hours of work")
    assert cli.main(["assimilate", files["measured"], "--method", "spline", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "checkpoint.pt").read_text() == "hours of work"


def test_a_damaged_checkpoint_is_told_before_any_work(files, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pipeline, "run_methods", None)
    (tmp_path / "checkpoint.pt").write_text("rubbish")
    assert cli.main(["assimilate", files["measured"], "--resume", "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "checkpoint.pt: is no checkpoint" in told and "remove it" in told and told.count("\n") == 1


def test_forecast(files, tmp_path):
    done = torchsph("forecast", files["truth"], "--leads", "0.01,0.005", *QUICK, "--save", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    names = {"metrics.json", "config.toml", "forecast.png", "forecast_5ms.h5", "forecast_10ms.h5"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    document = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(document) == {"leads", "seconds", "config", "failures"} and set(document["seconds"]) == {
        "setup",
        "forecast",
    }
    assert [row["lead"] for row in document["leads"]] == [0.005, 0.01]
    truth = geometry.read_recording(files["truth"])
    for row, ahead in zip(document["leads"], (1, 2), strict=True):
        assert row["starts"] == truth.frames - ahead
        assert row["nrmse"]["persistence"] == pytest.approx(persistence(truth, ahead), rel=1e-4)
        saved = geometry.read_recording(tmp_path / "out" / f"forecast_{1e3 * row['lead']:g}ms.h5")
        np.testing.assert_allclose(saved.time, truth.time[ahead:], atol=1e-9)
        both = truth.mask[ahead:] & truth.mask[:-ahead]
        assert row["nrmse"]["model"] == pytest.approx(
            pooled(saved.velocity - truth.velocity[ahead:], both) / pooled(truth.velocity[ahead:], both),
            rel=1e-3,
        )
    assert list(rows(done.stdout)) == ["lead", "5", "10"]


def pooled(velocity: np.ndarray, mask: np.ndarray) -> float:
    """RMS of a vector field over a mask."""
    return float(np.sqrt(np.mean(np.sum(velocity.astype(float) ** 2, 1)[mask])))


def persistence(truth: geometry.Recording, ahead: int) -> float:
    later, sooner = truth.velocity[ahead:], truth.velocity[:-ahead]
    both = truth.mask[ahead:] & truth.mask[:-ahead]
    return pooled(later - sooner, both) / pooled(later, both)


def test_measure_then_smooth_then_info(files, tmp_path):
    measured = torchsph("measure", files["truth"], "--out", "m.h5", "--every", "2", "--seed", "3", cwd=tmp_path)
    assert measured.returncode == 0, measured.stderr
    recording = geometry.read_recording(tmp_path / "m.h5")
    assert recording.frames == 3 and recording.weight is not None
    smoothed = torchsph("smooth", "m.h5", "--out", "s.h5", "--no-sidecar", cwd=tmp_path)
    assert smoothed.returncode == 0, smoothed.stderr
    assert list(rows(smoothed.stdout)) == ["method", "raw", "spline"]
    told = torchsph("info", "s.h5", cwd=tmp_path)
    assert told.returncode == 0 and "orifice 1" in told.stdout and "20 x 20 x 33 nodes" in told.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"m.h5", "s.h5"}


def test_measure_repeats_itself_with_the_same_seed_alone(files, tmp_path):
    def velocity(seed: int) -> np.ndarray:
        out = str(tmp_path / f"{seed}.h5")
        assert cli.main(["measure", files["truth"], "--out", out, "--seed", str(seed), "--lateral", "0.2"]) == 0
        return geometry.read_recording(out).velocity

    first, again, other = velocity(1), velocity(1), velocity(2)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_info_lists_the_backends(capsys):
    assert cli.main(["info", "--backends"]) == 0
    assert rows(capsys.readouterr().out)["reference"][:2] == ["cpu", "yes"]


def test_version(tmp_path):
    done = torchsph("--version", cwd=tmp_path)
    assert done.returncode == 0 and re.fullmatch(r"torchsph \d+\.\d+\.\d+\n", done.stdout)


# --- faults ----------------------------------------------------------------------------------------

FAULTS = {
    "no such file": (["assimilate", "gone.h5"], "gone.h5"),
    "no such truth": (["assimilate", "{measured}", "--truth", "gone.h5"], "gone.h5"),
    "not a recording": (["info", "{text}"], "text.h5"),
    "truth without measurement": (["assimilate", "--truth", "{truth}"], "--truth needs"),
    "truth of other times": (["assimilate", "{measured}", "--truth", "{late_truth}"], "no frame at"),
    "truth of another grid": (["assimilate", "{measured}", "--truth", "{coarse_truth}"], "another grid"),
    "unknown method": (
        ["assimilate", "{measured}", "--method", "spline,magic"],
        "unknown magic; known are free, spline",
    ),
    "empty method": (["assimilate", "{measured}", "--method", "spline,"], "empty name"),
    "unknown preset": (["assimilate", "{measured}", "--preset", "best"], "choose from"),
    "negative spacing": (["assimilate", "{measured}", "--spacing", "-0.001"], "must be above 0"),
    "spacing not a number": (["assimilate", "{measured}", "--spacing", "nan"], "must be above 0"),
    "spacing in millimetres": (["assimilate", "{measured}", "--spacing", "1"], "in metres"),
    "control in millimetres": (["assimilate", "{measured}", "--control-spacing", "1"], "--control-spacing: 1 m leaves"),
    "control and budget": (
        ["assimilate", "{measured}", "--control-spacing", "1e-3", "--budget", "9"],
        "leave --control-spacing out",
    ),
    "one member": (["assimilate", "{measured}", "--members", "1"], "at least 2"),
    "broken number": (["assimilate", "{measured}", "--seed", "one"], "not a whole number"),
    "negative seed": (["assimilate", "{measured}", "--seed", "-1"], "at least 0"),
    "unknown device": (["assimilate", "{measured}", "--device", "warp"], "unknown device 'warp'"),
    "device of another machine": (["assimilate", "{measured}", "--device", "cuda:99"], "no 'cuda:99'"),
    "output is a file": (["assimilate", "{measured}", "--out", "{text}"], "not a folder"),
    "output below a file": (["assimilate", "{measured}", "--out", "{text}/deeper"], "not a folder"),
    "leads between frames": (["forecast", "{truth}", "--leads", "0.0042"], "possible are 0.005, 0.01"),
    "leads beyond the recording": (["forecast", "{truth}", "--leads", "0.005,3"], "no frame lies 3 s"),
    "negative lead": (["forecast", "{truth}", "--leads", "-0.005"], "--leads"),
    "no start": (["forecast", "{truth}", "--every", "0"], "at least 1"),
    "share above one": (["measure", "{truth}", "--out", "m.h5", "--outliers", "2"], "at most 1"),
    "unknown mode": (["measure", "{truth}", "--out", "m.h5", "--mode", "magic"], "invalid choice"),
    "output in no folder": (["measure", "{truth}", "--out", "gone/m.h5"], "does not exist"),
    "output without name": (["smooth", "{measured}", "--out", "."], "is a folder"),
    "output missing": (["smooth", "{measured}"], "--out"),
    "nothing to look at": (["info"], "FILE"),
    "no value at all": (["assimilate", "{measured}", "--spacing=--"], "--spacing: '--' is no value"),
    "an escape": (["measure", "{truth}", "--out", "m.h5", "--every=\x1b[2J"], r"'\x1b[2J' is not a whole number"),
    "more alive than there are": (
        ["assimilate", "{measured}", "--members", "3", "--minimum-members", "4"],
        "only 3 members",
    ),
    "no such settings": (["info", "{truth}", "--config", "gone.toml"], "gone.toml"),
    "unknown command": (["improve"], "invalid choice"),
    "no command": ([], "COMMAND"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_ends_in_one_line_and_code_2(fault, files, tmp_path, monkeypatch, capsys):
    arguments, told = FAULTS[fault]
    monkeypatch.chdir(tmp_path)
    try:
        code = cli.main([argument.format(**files) for argument in arguments])
    except SystemExit as leaving:  # how argparse says it
        code = leaving.code
    streams = capsys.readouterr()
    assert code == 2 and streams.out == ""
    assert told in streams.err and streams.err.count("\n") == 1 and streams.err.startswith("torchsph")
    assert not list(tmp_path.iterdir())


def test_fault_in_a_process_of_its_own(tmp_path):
    done = torchsph("assimilate", "gone.h5", cwd=tmp_path)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "gone.h5" in done.stderr


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (RuntimeError("the flow\nblew up"), 1, "RuntimeError: the flow blew up"),
        (MemoryError(), 3, "out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 3, "try fewer --members"),
        (torchsph_package.NumericalFailure("all members failed"), 4, "all members failed"),
        (regularize.NotConverged("the solver"), 4, "the solver"),
        (Stopped("stopped by SIGTERM"), 75, "stopped by SIGTERM; run it again with --resume"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (PermissionError(13, "Permission denied", "there"), 2, "there: Permission denied"),
    ],
)
def test_failure_of_the_computation_leaves_nothing_behind(error, code, told, files, tmp_path, monkeypatch, capsys):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(pipeline, "run_methods", fail)
    assert cli.main(["assimilate", files["measured"], "--out", str(tmp_path / "out")]) == code
    assert told in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_failure_while_writing_leaves_the_older_results(files, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device", "report.png")

    (tmp_path / "metrics.json").write_text("older")
    monkeypatch.setattr(report, "draw_report", fail)
    arguments = ["assimilate", files["measured"], "--method", "spline", "--out", str(tmp_path)]
    assert cli.main(arguments) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]
    assert (tmp_path / "metrics.json").read_text() == "older"
