"""Whatever step of writing fails: an OSError, the older file intact, nothing left beside it."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from geometry import Recording, RecordingError, read_recording, write_recording
from geometry.recordings.whole_file import write_whole

STEPS = ("open", "write", "fchmod", "fsync", "close", "replace")


@pytest.fixture(name="small")
def _small(box_recording: Callable[..., Recording]) -> Recording:
    return box_recording(lambda points, t: 0.1 * np.cos(100 * points + t), nodes=4)


def _failing(step: str, which: int, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let the `which`-th call of a function of `os` fail; returns the list that counts its calls."""
    calls: list[int] = []
    real = getattr(os, step)

    def call(*given: object, **named: object) -> object:
        calls.append(len(calls))
        if len(calls) == which + 1:
            if step == "close":
                real(*given)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(*given, **named)

    monkeypatch.setattr(os, step, call)
    return calls


@pytest.mark.parametrize("step", STEPS)
def test_the_nth_step_fails_for_every_n(
    step: str, small: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "box.h5"
    write_recording(path, small)
    older = path.read_bytes()
    newer = small.with_velocity(0.5 * small.velocity)
    monkeypatch.setattr("geometry.recordings.whole_file._PIECE", len(older) // 3)  # several writes
    for which in range(20):
        path.write_bytes(older)
        with monkeypatch.context() as patch:
            calls = _failing(step, which, patch)
            try:
                write_recording(path, newer)
                failed = False
            except OSError as fault:
                failed = True
                assert fault.errno == errno.ENOSPC and str(tmp_path) in str(fault)
        assert os.listdir(tmp_path) == ["box.h5"]
        if len(calls) <= which:
            break
        # after the rename the new file stands there whole; before it the old one does
        assert path.read_bytes() == older or read_recording(path).velocity.max() == newer.velocity.max()
        assert failed or step in ("open", "close")  # of the folder, which is flushed where that can be done
    assert which > 0 and not failed
    np.testing.assert_array_equal(read_recording(path).velocity, newer.velocity)


def test_a_write_that_takes_less_than_it_was_given_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: real(handle, bytes(data)[:7]))
    write_whole(tmp_path / "file", bytes(range(250)))
    assert (tmp_path / "file").read_bytes() == bytes(range(250))


@pytest.mark.parametrize("limit", [0, 1, 1000])
def test_a_file_that_may_not_grow_ends_in_an_error(limit: int, small: Recording, tmp_path: Path) -> None:
    """The kernel's own refusal, at a byte of its choice."""
    resource, signal = pytest.importorskip("resource"), pytest.importorskip("signal")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(OSError, match=r"box\.h5"):
            write_recording(tmp_path / "box.h5", small)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert not os.listdir(tmp_path)


def test_a_folder_removed_meanwhile_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, real = tmp_path / "results", os.fsync
    folder.mkdir()

    def removing(handle: int) -> None:
        real(handle)
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()

    monkeypatch.setattr(os, "fsync", removing)
    with pytest.raises(FileNotFoundError, match="results/file"):
        write_whole(folder / "file", b"content")
    assert not folder.exists()


def test_links_pipes_and_folders_are_not_replaced(small: Recording, tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.write_text("somebody's")
    (tmp_path / "link").symlink_to(target)
    (tmp_path / "loose").symlink_to(tmp_path / "nowhere")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    before = {path.name: path.lstat() for path in tmp_path.iterdir()}
    for name in ("link", "loose", "folder", "pipe"):
        with pytest.raises(FileExistsError, match=f"{name}: is a .*name a regular file"):
            write_recording(tmp_path / name, small)
    after = {path.name: path.lstat() for path in tmp_path.iterdir()}
    assert after.keys() == before.keys() and target.read_text() == "somebody's"
    assert all(stat.S_IFMT(after[name].st_mode) == stat.S_IFMT(before[name].st_mode) for name in after)


def test_a_planted_link_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("somebody's")
    for name in (".file.part", "file.part"):
        (tmp_path / name).symlink_to(victim)
    write_whole(tmp_path / "file", b"content")
    assert victim.read_text() == "somebody's" and (tmp_path / "file").read_bytes() == b"content"


def test_text_that_no_file_can_hold_is_refused(small: Recording, tmp_path: Path) -> None:
    from dataclasses import replace

    for text in ("a\0b", "M\udcfcller"):
        with pytest.raises(RecordingError, match="attribute description: must be plain text"):
            write_recording(tmp_path / "box.h5", replace(small, description=text))
    assert not os.listdir(tmp_path)


def test_the_file_is_plain_hdf5(small: Recording, tmp_path: Path) -> None:
    """Made in memory, but with nothing of memory's in it: chunks, filters and layout as ever."""
    write_recording(tmp_path / "box.h5", small)
    with h5py.File(tmp_path / "box.h5") as file:
        velocity = file["velocity"]
        assert velocity.chunks == (1, *velocity.shape[1:]) and velocity.compression == "gzip" and velocity.shuffle
        assert file["time"].chunks is None
