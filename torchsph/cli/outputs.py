"""Output files that appear whole or not at all."""

from __future__ import annotations

import fcntl
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

import geometry
from geometry.formats import write_sidecar
from geometry.recordings.whole_file import move_together, refuse_special, write_whole, written_together

__all__ = ["output_folder", "staged", "write_analysis", "write_json", "write_result"]

_SCRATCH = ".torchsph-"


def output_folder(path: str | Path, files: Sequence[str] = ()) -> Path:
    """`path` as a folder that results may be written to.

    Asked before the work starts: a run of minutes must not end in a name that cannot be written.

    Args:
        path: of the folder, which need not be there.
        files: names of the results.

    Raises:
        ValueError: something else stands there, or nothing may be written to it.
        FileExistsError: a link, a device or a folder has the name of a result.
    """
    folder = Path(path)
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if not existing.is_dir():
        raise ValueError(f"--out {folder}: {existing} is a file, not a folder; choose another folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise ValueError(f"--out {folder}: no permission to write in {existing}; choose another folder")
    for file in files:
        refuse_special(folder / file)
    return folder


@contextmanager
def staged(folder: str | Path) -> Iterator[Path]:
    """A scratch folder whose files move into `folder` when the block ends well, and vanish otherwise.

    Scratch folders of runs that were killed are removed first. A file never takes the place of a link, a device or a
    folder: `FileExistsError` before any file has moved. Where a file cannot be moved, those before it are taken back.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _sweep(folder)
    scratch, lock = _locked_scratch(folder)
    try:
        yield scratch
        move_together(sorted(scratch.iterdir()), folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(lock)
        with suppress(OSError):  # the folder holds files already: the usual case, and then it stays
            folder.rmdir()


def write_analysis(
    path: str | Path, recording: geometry.Recording, account: Mapping[str, object], *, sidecar: bool
) -> None:
    """Write a result, with the files by which viewers open it beside it: all of them or none.

    Args:
        path: of the recording.
        recording: the result.
        account: where it comes from.
        sidecar: whether viewers get files.
    """
    path = Path(path)
    if not sidecar:
        write_result(path, recording, account)
        return
    for beside in ("", "_wall"):
        refuse_special(path.with_name(f"{path.stem}{beside}.vtkhdf"))
    with written_together(path.parent) as scratch:
        write_result(scratch / path.name, recording, account)
        write_sidecar(scratch / path.name, recording)


def write_result(path: Path, recording: geometry.Recording, account: Mapping[str, object]) -> None:
    """Write a recording that was computed.

    Args:
        path: of the recording.
        recording: the result.
        account: where it comes from.

    Raises:
        NumericalFailure: it breaks a rule of recordings. The input did not, so that a cure for files does not help.
    """
    try:
        geometry.write_recording(path, recording, provenance=account)
    except geometry.RecordingError as fault:
        from torchsph.simulator.failures import NumericalFailure  # here, because it brings torch along

        broken = fault.rule.partition(";")[0].partition(", so it is")[0]  # what follows are cures
        raise NumericalFailure(f"what was computed is no flow: its {fault.dataset} {broken}") from fault


def _locked_scratch(folder: Path) -> tuple[Path, int]:
    """A new scratch folder and the handle that locks it for as long as this process lives."""
    while True:
        scratch = Path(tempfile.mkdtemp(prefix=_SCRATCH, dir=folder))
        handle = os.open(scratch, os.O_RDONLY)
        with suppress(OSError):  # a file system without locks: then nobody can sweep, either
            fcntl.flock(handle, fcntl.LOCK_EX)
        if scratch.exists():  # else another run has swept it between the two steps
            return scratch, handle
        os.close(handle)


def _sweep(folder: Path) -> None:
    """Remove the scratch folders whose runs are gone: nobody holds their lock."""
    for left in folder.glob(f"{_SCRATCH}*"):
        with suppress(OSError):
            handle = os.open(left, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(left, ignore_errors=True)
            finally:
                os.close(handle)


def write_json(path: str | Path, content: Any) -> None:
    """Strict JSON: arrays become lists, and what is not finite becomes `null`, which every reader takes."""
    write_whole(path, (json.dumps(_plain(content), indent=1, allow_nan=False) + "\n").encode())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    return str(value)  # a path, a device, a dtype: by its name
