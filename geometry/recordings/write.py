"""Writing a recording file: whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import h5py
import numpy as np

from .checks import refuse_implausible
from .recording import Recording
from .rules import check_recording


def write_recording(path: str | Path, recording: Recording, *, strict: bool = False) -> None:
    """Write a recording file that every reader of the format accepts, replacing a file of that name.

    The file is written under another name in the same directory, flushed to the disk and then renamed, so
    that whoever looks sees the old file or the new one, never a part. The velocity is stored as 0
    outside the mask.

    Args:
        path: of the file.
        recording: what to write.
        strict: refuse whatever is odd about it (`findings`), too.

    Raises:
        RecordingError: it breaks a rule or cannot be meant; nothing is written.
        FileNotFoundError: the directory does not exist.
        OSError: the disk is full.
    """
    path = Path(path)
    check_recording(recording, str(path))
    refuse_implausible(recording, str(path), strict=strict)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no directory {path.parent}; make it first")
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    os.close(handle)
    try:
        with h5py.File(name, "w") as file:
            _fill(file, recording)
        _flush(name)
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
    _flush(str(path.parent))


def _fill(file: h5py.File, recording: Recording) -> None:
    file.attrs.update(
        format="recording",
        format_version=1,
        dimension=recording.dimension,
        rho=recording.rho,
        mu=recording.mu,
        period=recording.period,
        description=recording.description,
    )
    grid = file.create_group("grid")
    grid.attrs["origin"], grid.attrs["spacing"] = (
        np.array(recording.grid.origin),
        np.array(recording.grid.spacing),
    )
    for dataset, values in recording.arrays().items():
        if dataset == "/velocity":
            values = np.where(recording.mask[:, None], values, np.float32(0))
        if values.dtype == np.bool_:
            values = values.astype(np.uint8)
        # One chunk a frame: a frame is what is read at a time. Small and empty arrays are stored as they are.
        many = values.ndim > 2 and values.size > 0
        options = {"chunks": (1, *values.shape[1:]), "compression": "gzip", "shuffle": True} if many else {}
        file.create_dataset(dataset, data=values, **options)


def _flush(name: str) -> None:
    descriptor = os.open(name, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _umask() -> int:
    """The process's file mode mask: mkstemp ignores it, but the file should be as readable as any other."""
    current = os.umask(0)
    os.umask(current)
    return current
