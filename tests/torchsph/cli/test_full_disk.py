"""Whatever step of writing fails, at whatever byte: exit 2, nothing left behind, the earlier results as they were."""

from __future__ import annotations

import errno
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from geometry import Recording, write_recording
from torchsph.cli.commands import assimilate, smooth
from torchsph.cli.main import main
from torchsph.methods.by_name import MethodResult
from torchsph.methods.runtime import checkpoint

Files = dict[str, bytes]


@pytest.fixture(name="measured")
def _measured(box_recording: Callable[..., Recording], tmp_path: Path) -> Path:
    path = tmp_path / "m.h5"
    write_recording(path, box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4))
    return path


@pytest.fixture(name="quick")
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results without the work: what is tested is how they are written."""

    def analysed(measured: Recording) -> Recording:
        return measured.with_velocity(0.5 * measured.velocity)

    def drawn(path: Path, *_: object) -> None:
        Path(path).write_bytes(bytes(5000))

    monkeypatch.setattr(smooth.PreparedMeasurement, "smoothed", property(lambda prepared: analysed(prepared.recording)))
    monkeypatch.setattr(
        assimilate.by_name, "run_methods", lambda measured, *_, **__: {"spline": MethodResult(analysed(measured), 1.0)}
    )
    monkeypatch.setattr(assimilate.figures, "draw_report", drawn)


COMMANDS = {
    "smooth": "smooth m.h5 --out results/s.h5",
    "smooth alone": "smooth m.h5 --out results/s.h5 --no-sidecar",
    "assimilate": "assimilate m.h5 --method spline --out results",
    "export npz": "export m.h5 --to npz --out results/e",
    "export mat": "export m.h5 --to mat --out results/e",
    "export vtkhdf": "export m.h5 --to vtkhdf --out results/e",
    "convert": "convert e.npz --out results/c.h5 --velocity velocity --mask mask --axes tczyx --spacing 2.5,2.5,2.5 "
    "--length-unit mm --time time --time-unit s --velocity-unit m/s",
}


@pytest.fixture(name="run")
def _run(measured: Path, quick: None, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], int]:
    monkeypatch.chdir(measured.parent)
    assert main(["export", "m.h5", "--to", "npz", "--out", "e"]) == 0
    Path("results").mkdir()
    return lambda name: main(COMMANDS[name].split())


def content(folder: Path = Path("results")) -> Files:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != ".torchsph.lock"}


def restore(before: Files) -> None:
    """Put the results back to what they were."""
    for name in content():
        Path("results", name).unlink()
    for name, data in before.items():
        Path("results", name).write_bytes(data)


def older_results(run: Callable[[str], int], name: str) -> Files:
    """Results of an earlier run, told apart from new ones."""
    assert run(name) == 0
    restore({file: b"older " + file.encode() for file in content()})
    return content()


@contextmanager
def failing(step: str, which: int) -> Iterator[list[int]]:
    """Let the `which`-th call of a function of `os` fail; the list counts its calls."""
    calls: list[int] = []
    real = getattr(os, step)

    def call(*given: object, **named: object) -> object:
        calls.append(len(calls))
        if len(calls) == which + 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*given, **named)

    setattr(os, step, call)
    try:
        yield calls
    finally:
        setattr(os, step, real)


@contextmanager
def no_file_beyond(limit: int) -> Iterator[None]:
    """The kernel refuses to let any file grow beyond so many bytes."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "assimilate" else []) for name in COMMANDS]
)
def test_the_nth_step_fails_for_every_n(name: str, run: Callable[[str], int]) -> None:
    before = older_results(run, name)
    alone = name in (
        "smooth alone",
        "convert",
    )  # one file: where only its folder could not be flushed, it stands there whole
    tried = 0
    for step in ("write", "fsync", "rename", "replace"):
        for which in range(100):
            with failing(step, which) as calls:
                code = run(name)
            if len(calls) <= which:
                assert code == 0
                break
            after, tried = content(), tried + 1
            assert code == 2, (step, which)
            assert after == before or (alone and after.keys() == before.keys()), (step, which, sorted(after))
            restore(before)
        restore(before)
    assert tried >= 3


@pytest.mark.parametrize("name", COMMANDS)
def test_the_disk_is_full_at_any_byte(name: str, run: Callable[[str], int]) -> None:
    assert run(name) == 0
    largest = max(len(data) for data in content().values())
    for before in ({}, {file: b"older " + file.encode() for file in content()}):
        restore(before)
        for limit in (0, 40, largest // 2, largest - 1):
            with no_file_beyond(limit):
                code = run(name)
            assert code == 2 and content() == before, limit


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_is_gone_or_may_not_be_written_to(name: str, run: Callable[[str], int]) -> None:
    Path("results").rmdir()
    if name == "assimilate":  # makes its folder; a file in its place is no folder
        Path("results").write_text("somebody's")
        assert run(name) == 2 and Path("results").read_text() == "somebody's"
        return
    assert run(name) == 2
    assert sorted(path.name for path in Path().iterdir()) == ["e.npz", "m.h5"]
    if os.getuid() != 0:
        Path("results").mkdir(mode=0o500)
        assert run(name) == 2 and not content()


def test_a_checkpoint_survives_the_failure_of_every_step(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, "key", {"frame": 1})
    before = path.read_bytes()
    for step in ("write", "fsync", "replace"):
        for which in range(20):
            with failing(step, which) as calls:
                try:
                    checkpoint.save(path, "key", {"frame": 2})
                except OSError as fault:
                    assert fault.errno == errno.ENOSPC
            if len(calls) <= which:
                break
            assert [entry.name for entry in tmp_path.iterdir()] == ["checkpoint.pt"]
            state = checkpoint.shared_state(checkpoint.Saved.read(path), "key")
            assert state in ({"frame": 1}, {"frame": 2})
            path.write_bytes(before)
        assert which > 0
        path.write_bytes(before)
