"""Members on the disk: an HDF5 file beside the analysis, written frame by frame, read frame by frame.

Values are rounded to 12 bits of mantissa (a relative error of 1.2e-4, far below every deviation) and compressed without
further loss: the bits that carry nothing would take most of the file. What it may take at most is known before the run
(`most_bytes`) and held against the free disk.

| dataset | shape | unit |
|---|---|---|
| `/time` | (T,) | s |
| `/members` | (T, N, D, *shape) | m/s |
| `/rate`, `/member_rates` | (T, D, *shape), (T, N, D, *shape) | m/s^2 |
| `/pressure` | (T, *shape) | Pa |
| `/coarser`, `/coarser_rate` | (T, D, *shape) | m/s, m/s^2 |

The attribute `frames_done` says how many frames are there. The estimate itself is the analysis's `/velocity`;
`/coarser` is that as the measurement's kernel would show it once more, where a kernel is known.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

import geometry

from .frames import MemberFrame

__all__ = ["MemberFile", "most_bytes", "read_members", "rounded"]

_KEPT_BITS = 12
_FORMAT = "members"


def most_bytes(recording: geometry.Recording, members: int) -> int:
    """What a file of the members of a recording takes at most: every number inside the mask, uncompressed."""
    inside = int(np.asarray(recording.mask, bool).sum())
    return 4 * inside * (2 * members * recording.dimension + 3 * recording.dimension + 1)


def rounded(values: NDArray[np.floating], bits: int = _KEPT_BITS) -> NDArray[np.float32]:
    """float32 values rounded to so many bits of mantissa, to nearest; what is not finite stays so."""
    array = np.ascontiguousarray(values, np.float32)
    drop = 23 - bits
    half = np.uint32(1 << (drop - 1))
    whole = (array.view(np.uint32) + half) & np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    return np.where(np.isfinite(array), whole.view(np.float32), array)


class MemberFile:
    """Writes every frame that it is handed; each is on the disk when `take` returns.

    Args:
        path: of the file; it is made when the first frame comes.
        recording: whose grid, masks and times the members have.
        members: N.

    Raises:
        OSError: the disk has not enough room for all that it may take.
    """

    def __init__(self, path: str | Path, recording: geometry.Recording, members: int) -> None:
        self.path, self.recording, self.members = Path(path), recording, members
        wanted, free = most_bytes(recording, members), shutil.disk_usage(self.path.parent).free
        if wanted > free:
            raise OSError(
                f"{self.path}: {members} members of {recording.frames} frames may take {wanted / 1e6:.0f} MB, but only "
                f"{free / 1e6:.0f} MB are free; make room, or leave --keep-members out"
            )

    def take(self, frame: MemberFrame) -> None:
        """Write one frame."""
        with h5py.File(self.path, "w" if frame.frame == 0 else "r+") as file:
            if frame.frame == 0:
                self._begin(file, frame)
            file["members"][frame.frame] = rounded(frame.members)
            file["rate"][frame.frame] = rounded(frame.rate)
            file["member_rates"][frame.frame] = rounded(frame.member_rates)
            if frame.pressure is not None:
                file["pressure"][frame.frame] = rounded(frame.pressure)
            if frame.coarser is not None and frame.coarser_rate is not None:
                file["coarser"][frame.frame] = rounded(frame.coarser)
                file["coarser_rate"][frame.frame] = rounded(frame.coarser_rate)
            file.attrs["frames_done"] = frame.frame + 1

    def state(self) -> dict[str, Any]:
        """Nothing: the file itself is there."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """See that the file of the run before is there.

        Raises:
            ValueError: it is not.
        """
        if not self.path.is_file():
            raise ValueError(f"{self.path}: the members kept so far are gone; start anew, without --resume")

    def _begin(self, file: h5py.File, frame: MemberFrame) -> None:
        count, shape = self.recording.frames, frame.field.shape
        sizes = {
            "members": (len(frame.members), *shape),
            "rate": shape,
            "member_rates": (len(frame.members), *shape),
            "pressure": shape[1:],
        }
        if frame.coarser is not None:
            sizes |= {"coarser": shape, "coarser_rate": shape}
        for name, size in sizes.items():
            chunk = (1, 1, *shape) if len(size) > len(shape) else (1, *size)
            file.create_dataset(
                name, (count, *size), np.float32, chunks=chunk, compression="gzip", shuffle=True, fillvalue=np.nan
            )
        file["time"] = self.recording.time
        file.attrs.update(format=_FORMAT, format_version=1, frames_done=0)


def read_members(path: str | Path, analysis: geometry.Recording) -> Iterator[MemberFrame]:
    """The frames of a file, one at a time.

    Args:
        path: of the file.
        analysis: the recording that was written with it.

    Raises:
        FileNotFoundError: there is no file.
        ValueError: it is no file of members, or one of another analysis, or of a run that did not end.
    """
    source = Path(path)
    if not source.is_file():
        raise FileNotFoundError(f"{source}: there is no such file")
    try:
        file = h5py.File(source, "r")
    except OSError as fault:
        raise ValueError(f"{source}: is not a readable HDF5 file ({fault}); give the members.h5 of a run") from fault
    with file:
        _check(file, source, analysis)
        for frame in range(analysis.frames):
            pressure = file["pressure"][frame]
            coarser = [file[name][frame] if name in file else None for name in ("coarser", "coarser_rate")]
            yield MemberFrame(
                frame,
                analysis.velocity[frame],
                file["members"][frame],
                file["rate"][frame],
                file["member_rates"][frame],
                pressure if np.isfinite(pressure).any() else None,
                *coarser,
            )


def _check(file: h5py.File, source: Path, analysis: geometry.Recording) -> None:
    if file.attrs.get("format") != _FORMAT:
        raise ValueError(f"{source}: is no file of members (attribute format); give the members.h5 of a run")
    time, shape = np.asarray(file["time"]), file["members"].shape
    if shape[0] != analysis.frames or shape[2:] != analysis.velocity.shape[1:] or not np.allclose(time, analysis.time):
        raise ValueError(f"{source}: its times or grid are not those of the analysis; give the one of the same run")
    done = int(file.attrs["frames_done"])
    if done < analysis.frames:
        raise ValueError(f"{source}: holds only {done} of {analysis.frames} frames: its run did not end")
