"""`xarray.open_dataset(file, engine="torchsph")`: a recording file as a dataset."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import h5py
import xarray
from xarray.backends import BackendEntrypoint

from geometry.recordings.read import read_recording

from .labelled_arrays import to_xarray
from .readers.hdf5 import text


class RecordingEntrypoint(BackendEntrypoint):
    """Reads and validates the whole file; `xarray` finds it by the entry point `torchsph`."""

    description = "Recordings of torchsph: velocity volumes with walls and valves"
    open_dataset_parameters = ("filename_or_obj", "drop_variables")

    def open_dataset(
        self, filename_or_obj: str | Path, *, drop_variables: str | Iterable[str] | None = None
    ) -> xarray.Dataset:
        """The recording, without the variables named."""
        return to_xarray(read_recording(filename_or_obj)).drop_vars(drop_variables or [])

    def guess_can_open(self, filename_or_obj: object) -> bool:
        """Whether the file says that it is a recording."""
        try:
            path = Path(str(filename_or_obj))
            if not path.is_file() or not h5py.is_hdf5(path):
                return False
            with h5py.File(path, "r") as file:
                return text(file.attrs.get("format", "")) == "recording"
        except (TypeError, OSError):
            return False
