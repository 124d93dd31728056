"""What surrounds a run: settings in files, notes, exit codes, signals, status, the folder's lock, isolation."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from torchsph.cli import main
from torchsph.cli.arguments import Parser, add_model_options, names, number, whole
from torchsph.cli.exit_codes import ExitCode, exit_code
from torchsph.cli.program import parsed
from torchsph.cli.running import notes, provenance
from torchsph.cli.running.folder_lock import NAME, locked
from torchsph.cli.running.isolated import isolated
from torchsph.cli.running.settings import as_arguments, config_text, settings_of
from torchsph.cli.running.status import RunWatcher, StatusFile
from torchsph.cli.running.stopping import StopSignals
from torchsph.methods.runtime.watching import FrameDone, Stopped

# --- settings --------------------------------------------------------------------------------------


def config(path: Path, text: str) -> list[str]:
    path.write_text(text)
    return ["--config", str(path)]


def test_a_file_gives_defaults_that_the_command_line_overrides(tmp_path):
    text = (
        'seed = 3\n[assimilate]\nmeasurement = "m.h5"\nmethod = ["spline", "ensemble"]\nspacing = 3e-3\nresume = true\n'
    )
    text += 'also = ["a.h5"]\n[forecast]\nleads = [0.01]\n'
    file = config(tmp_path / "c.toml", text)
    args = parsed(["assimilate", *file, "--spacing", "0.002", "--also", "b.h5"])
    assert (args.measurement, args.method, args.seed) == ("m.h5", ("spline", "ensemble"), 3)
    assert (args.spacing, args.resume, args.also) == (0.002, True, ["a.h5", "b.h5"])
    assert parsed(["assimilate", "other.h5", *file]).measurement == "other.h5"
    assert parsed(["forecast", "r.h5", *file]).leads == (0.01,)
    assert parsed(["measure", *config(tmp_path / "m.toml", 'true="t.h5"\nout="o.h5"\napex=[0, 0, 1.5]')]).apex == [
        0,
        0,
        1.5,
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("spacing = ", "is no TOML"),
        ("members = 1", "members: 1 is too small"),
        ("member = 4", "has no option 'member'; did you mean members"),
        ("resume = 1", "resume: is true or false, not 1"),
        ("preset = 'best'", "preset: is one of"),
        ("spacing = {a = 1}", "[spacing] is no command"),
        ("spacing = 1979-05-27", "spacing: is a number or a text"),
        ("[improve]\nx = 1", "[improve] is no command"),
    ],
)
def test_what_a_file_gets_wrong_is_told_by_its_name(text, told, tmp_path, capsys):
    assert main(["assimilate", "m.h5", *config(tmp_path / "c.toml", text)]) == 2
    streams = capsys.readouterr()
    assert f"--config {tmp_path}/c.toml: " in streams.err and told in streams.err and streams.err.count("\n") == 1


def test_the_resolved_settings_repeat_a_run(tmp_path):
    line = [
        "assimilate",
        'odd "name"\\.h5',
        "--method",
        "free,spline",
        "--spacing",
        "0.0025",
        "--also",
        "a.h5",
        "--quiet",
    ]
    args = parsed(line)
    text = config_text(args)
    assert tomllib.loads(text)["assimilate"]["spacing"] == 0.0025
    again = parsed(["assimilate", *config(tmp_path / "config.toml", text)])
    skipped = {"config"}
    assert {k: v for k, v in vars(again).items() if k not in skipped} == {
        k: v for k, v in vars(args).items() if k not in skipped
    }


def test_options_become_a_command_line_again():
    parser = Parser()
    add_model_options(parser)
    parser.add_argument("--method", type=names)
    parser.add_argument("--also", action="append", default=[])
    parser.add_argument("--apex", nargs="+", type=number(0))
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--members", type=whole(2))
    line = ["--spacing=0.003", "--method=a,b", "--also=x", "--also=-y", "--apex", "1.0", "2.0", "--verbose"]
    args = parser.parse_args(line)
    assert as_arguments(parser, vars(args)) == line
    assert as_arguments(parser, vars(parser.parse_args([]))) == []


# --- notes and exit codes --------------------------------------------------------------------------


def options(**given: object) -> argparse.Namespace:
    plain = {"command": "info", "verbose": False, "quiet": False, "json": False}
    return argparse.Namespace(**(plain | given))


def test_notes_are_as_many_and_as_plain_as_asked_for(capsys):
    import warnings

    def told(**given: object) -> list[str]:
        with notes.told(options(**given)):
            notes.LOGGER.debug("detail")
            notes.LOGGER.info("note of a \x1b[2Jfile")
            warnings.warn("odd\nwall", UserWarning, stacklevel=1)
            warnings.warn("programmers' matter", RuntimeWarning, stacklevel=1)
        return capsys.readouterr().err.splitlines()

    assert told() == ["note of a \\x1b[2Jfile", "torchsph: warning: odd wall"]
    assert told(verbose=True) == ["detail", *told(), "programmers' matter"]
    assert told(quiet=True) == []
    lines = [json.loads(line) for line in told(json=True)]
    assert [(line["level"], line["message"]) for line in lines] == [
        ("info", "note of a \x1b[2Jfile"),
        ("warning", "odd wall"),
    ]
    assert not notes.LOGGER.handlers and notes.LOGGER.level == logging.NOTSET


def test_a_fault_is_json_where_that_is_asked_for(capsys):
    assert main(["info", "gone.h5", "--json"]) == 2
    told = json.loads(capsys.readouterr().err)
    assert told["level"] == "error" and told["code"] == 2 and "gone.h5" in told["message"]


def test_nobody_listening_is_no_fault(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    with notes.told(options()):
        notes.LOGGER.info("note")
    assert main(["info", "gone.h5"]) == 2


def test_every_fault_has_its_code():
    import numpy as np
    import torch

    import geometry
    import regularize
    from torchsph import NumericalFailure

    codes = {
        Stopped(): 75,
        KeyboardInterrupt(): 130,
        MemoryError(): 3,
        torch.OutOfMemoryError("CUDA out of memory"): 3,
        NumericalFailure(): 4,
        regularize.NotConverged("the solver"): 4,
        np.linalg.LinAlgError(): 4,
        ZeroDivisionError(): 4,
        geometry.RecordingError("file", "/time", "rule"): 2,
        regularize.InvalidInput(): 2,
        PermissionError(): 2,
        KeyError(): 1,
        RuntimeError("something else"): 1,
    }
    assert {type(fault): exit_code(fault) for fault in codes} == {type(fault): code for fault, code in codes.items()}
    assert ExitCode.RESUME == os.EX_TEMPFAIL


# --- signals and status ----------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_stops_at_once_or_at_the_next_resting_place_but_the_second_always_at_once(number):
    before = signal.getsignal(number)
    with pytest.raises(Stopped, match=f"stopped by {number.name}"), StopSignals():
        signal.raise_signal(number)
    with StopSignals() as signals:
        signals.waits = True
        assert not signals.asked
        signal.raise_signal(number)
        assert signals.asked
        with pytest.raises(Stopped):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before


def test_the_status_tells_how_far_a_run_is(tmp_path):
    path = tmp_path / "status.jsonl"
    with pytest.raises(Stopped), StatusFile(path) as status:
        watcher = RunWatcher(StopSignals(), status)
        watcher.begins()
        assert watcher.signals.waits and not watcher.asked_to_stop()
        for frame in range(2):
            time.sleep(0.02)
            watcher.frame_done(FrameDone(frame, 4, alive=3 - frame, members=3))
        raise Stopped("stopped after frame 2 of 4")
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["event"] for line in lines] == ["begun", "frame", "frame", "stopped"]
    assert [(line["frame"], line["frames"], line["alive"], line["members"]) for line in lines[1:3]] == [
        (1, 4, 3, 3),
        (2, 4, 2, 3),
    ]
    done = lines[2]["seconds"]  # of two frames of four: as much is left, less what passed before the first one began
    assert 2 * 0.02 <= lines[2]["left"] <= done and lines[2]["end"] >= lines[2]["time"]
    assert lines[-1]["code"] == 75 and lines[-1]["seconds"] > 0.04
    assert all(line["peak"] >= line["memory"] * 0.9 > 1e7 for line in lines)


def test_a_status_that_cannot_be_written_is_told_once_and_ends_nothing(tmp_path, caplog):
    with StatusFile(tmp_path / "gone" / "status.jsonl") as status:
        status.write("frame")
    assert len(caplog.records) == 1 and "status.jsonl: cannot be written" in caplog.text


# --- the folder's lock -----------------------------------------------------------------------------

HOLD = """
import sys, time
from torchsph.cli.running.folder_lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_runs_do_not_share_a_folder_and_the_lock_of_a_killed_one_is_taken_over(tmp_path):
    program = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    other = subprocess.Popen(program, stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=rf"out: another run is at work there, process {other.pid} on .* since 2"):
            locked(tmp_path / "out").__enter__()
    finally:
        other.kill()
        other.wait()
    assert (tmp_path / "out" / NAME).exists()
    with locked(tmp_path / "out") as folder:
        assert json.loads((folder / NAME).read_text())["pid"] == os.getpid()
        (folder / "result").touch()
    assert [path.name for path in folder.iterdir()] == ["result"]


def test_the_lock_of_another_machine_stands_until_somebody_removes_it(tmp_path):
    lock = tmp_path / NAME
    lock.write_text(json.dumps({"host": "elsewhere", "pid": 1, "started": "2020"}))
    with pytest.raises(ValueError, match=rf"process 1 on elsewhere since 2020; .*if that run is over, remove {lock}"):
        locked(tmp_path).__enter__()
    lock.unlink()
    with locked(tmp_path):
        pass


def test_a_folder_made_for_a_run_that_left_nothing_vanishes_and_a_planted_lock_is_not_followed(tmp_path):
    with locked(tmp_path / "new"):
        assert (tmp_path / "new" / NAME).exists()
    assert not (tmp_path / "new").exists()
    (tmp_path / "victim").write_text("somebody's")
    (tmp_path / NAME).symlink_to(tmp_path / "victim")
    with pytest.raises(OSError, match="symbolic link"):
        locked(tmp_path).__enter__()
    assert (tmp_path / "victim").read_text() == "somebody's"


# --- isolation -------------------------------------------------------------------------------------


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def refuse() -> None:
    raise ValueError("m.h5: /time: is missing")


def test_a_child_gives_its_result_or_its_fault():
    def child(work, seconds: float = 20.0):
        return isolated(work, "m.h5", seconds=seconds, memory=1 << 28)

    assert child(lambda: {"rows": [["ä", "1"]]}) == {"rows": [["ä", "1"]]}
    with pytest.raises(ValueError, match="m.h5: /time: is missing"):
        child(refuse)
    with pytest.raises(ValueError, match="m.h5: reading it ended a process by SIGSEGV"):
        child(crash)
    with pytest.raises(ValueError, match="m.h5: reading it ended a process without a word"):
        child(lambda: os._exit(0))
    with pytest.raises(ValueError, match=r"m.h5: reading it took longer than 0.2 s"):
        child(lambda: time.sleep(60), seconds=0.2)
    with pytest.raises(MemoryError):
        child(lambda: len(bytearray(1 << 30)))
    with pytest.raises(RuntimeError, match="KeyError"):
        child(lambda: {}["missing"])


def test_info_reads_apart_and_tells_what_a_run_would_take(box_recording, tmp_path, monkeypatch, capsys):
    import geometry
    from torchsph.cli.commands import info

    path = tmp_path / "m.h5"
    measured = box_recording(lambda points, t: 0.1 + 0 * points, nodes=6)
    geometry.write_recording(path, measured, provenance={"torchsph": "0.1.0", "seed": 0, "commit": "\x1b[2J"})
    assert main(["info", str(path)]) == 0
    plain = capsys.readouterr()
    assert "made by" in plain.out and "commit \\x1b[2J" in plain.out
    assert "GB for ensemble beside the program's own" in plain.out
    assert main(["info", str(path), "--isolated"]) == 0
    apart = capsys.readouterr()
    assert apart.out.splitlines()[:-1] == plain.out.splitlines()[:-1] and apart.err == plain.err
    monkeypatch.setattr(info.geometry, "read_recording", lambda _: crash())
    assert main(["info", str(path), "--isolated"]) == 2
    assert f"{path}: reading it ended a process by SIGSEGV" in capsys.readouterr().err
    monkeypatch.setattr(info.geometry, "read_recording", lambda _: time.sleep(60))
    assert main(["info", str(path), "--isolated", "--seconds", "0.2"]) == 2
    assert "took longer than 0.2 s" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "gone.h5"), "--isolated"]) == 2


# --- where results come from -----------------------------------------------------------------------


def test_the_fingerprint_follows_settings_and_content_and_nothing_else(tmp_path):
    for name, text in (("one.h5", "a"), ("copy.h5", "a"), ("other.h5", "b")):
        (tmp_path / name).write_text(text)

    def key(name: str, *more: str) -> str:
        args = parsed(["assimilate", str(tmp_path / name), *more])
        return provenance.fingerprint(args, provenance.input_digests({"measurement": args.measurement}))

    silent = ("--out", "x", "--status", "s", "--quiet", "--resume", "--minimum-members", "2")
    assert key("one.h5") == key("copy.h5") == key("one.h5", *silent)
    others = [key("other.h5"), key("one.h5", "--seed", "1"), key("one.h5", "--spacing", "0.001")]
    assert len({key("one.h5"), *others}) == 4
    args = parsed(["assimilate", str(tmp_path / "one.h5")])
    account = provenance.provenance(args, {"measurement": args.measurement, "truth": None, "also": []})
    assert list(account["inputs"]) == ["measurement"] and account["fingerprint"] == key("one.h5")
    assert {"torch", "numpy", "h5py", "python"} <= set(account["dependencies"])
    assert account["settings"] == {
        k: v for k, v in settings_of(args).items() if k not in ("measurement", "truth", "also")
    }
    json.dumps(account)
