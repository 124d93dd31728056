"""NetCDF with CF attributes, by xarray."""

from __future__ import annotations

from pathlib import Path

from geometry.formats.labelled_arrays import to_xarray
from geometry.recordings.recording import Recording


def write_netcdf(path: Path, recording: Recording) -> list[Path]:
    """The dataset of `to_xarray`."""
    to_xarray(recording).to_netcdf(path)
    return [path]
