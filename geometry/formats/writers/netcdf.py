"""NetCDF with CF attributes, by xarray."""

from __future__ import annotations

import errno
from pathlib import Path

from geometry.formats.labelled_arrays import to_xarray
from geometry.formats.own.mark import MARK
from geometry.recordings.recording import Recording


def write_netcdf(path: Path, recording: Recording) -> list[Path]:
    """The dataset of `to_xarray`."""
    dataset = to_xarray(recording)
    dataset.attrs[MARK] = "1"
    try:
        dataset.to_netcdf(path)
    except RuntimeError as fault:  # what the library makes of a disk that is full
        raise OSError(errno.EIO, f"the file could not be written ({fault})", str(path)) from fault
    return [path]
