"""Writing a recording file: whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from geometry.arguments import checked

from .checks import refuse_implausible
from .quality import QUALITY_NAMES
from .recording import Recording
from .rules import check_recording
from .whole_file import refuse_special, write_whole


@checked
def write_recording(
    path: str | Path,
    recording: Recording,
    *,
    strict: bool = False,
    provenance: Mapping[str, object] | None = None,
) -> None:
    """Write a recording file that every reader of the format accepts, replacing a file of that name.

    The file is made in memory and then written by `write_whole`: HDF5 never meets a disk that is full, and whoever
    looks sees the old file or the new one, never a part. The velocity is stored as 0 outside the mask.

    Args:
        path: of the file; its folder exists.
        recording: what is written.
        strict: refuse whatever is odd about the recording (`findings`), not only what cannot be meant.
        provenance: what made it (versions, settings, inputs), of numbers, texts, lists and dictionaries; it becomes the
            attribute `provenance`, as JSON, which `read_provenance` reads again.

    Raises:
        RecordingError: before anything is written, the recording breaks a rule or cannot be meant.
        FileNotFoundError: the folder does not exist.
        OSError: the disk is full, the folder cannot be written to, or a link, device or folder has the name.
    """
    path = Path(path)
    check_recording(recording, str(path))
    refuse_implausible(recording, str(path), strict=strict)
    refuse_special(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no directory {path.parent}; make it first")
    write_whole(path, _image(recording, provenance))


def _image(recording: Recording, provenance: Mapping[str, object] | None) -> bytes:
    """The bytes of the file, about as many as it takes on the disk."""
    with h5py.File("recording in memory", "w", driver="core", backing_store=False) as file:
        _fill(file, recording)
        if provenance is not None:
            file.attrs["provenance"] = json.dumps(provenance, default=str)
        file.flush()
        return file.id.get_file_image()


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
    if recording.cut:
        file.attrs["cut"] = 1
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
        stored = file.create_dataset(dataset, data=values, **options)
        if dataset == "/quality":
            stored.attrs["names"] = list(QUALITY_NAMES)
