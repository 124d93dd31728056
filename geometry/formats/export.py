"""From recordings to the files of viewers and other programs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from geometry.arguments import checked
from geometry.recordings.recording import Recording
from geometry.recordings.whole_file import written_together

from .source import FormatError
from .writers.matlab import write_matlab
from .writers.netcdf import write_netcdf
from .writers.nifti import write_nifti
from .writers.npz import write_npz
from .writers.nrrd_file import write_nrrd
from .writers.vti import write_vti
from .writers.vtkhdf import write_vtkhdf

EXPORTS: dict[str, tuple[str, Callable[[Path, Recording], list[Path]]]] = {
    "vtkhdf": (".vtkhdf", write_vtkhdf),
    "vti": (".vti", write_vti),
    "nifti": (".nii.gz", write_nifti),
    "nrrd": (".seq.nrrd", write_nrrd),
    "mat": (".mat", write_matlab),
    "netcdf": (".nc", write_netcdf),
    "npz": (".npz", write_npz),
}
"""Formats by name: the end of their files' names, and what writes them. A new one is a file and a line here."""


@checked
def export(recording: Recording, path: str | Path, to: str) -> list[Path]:
    """Write a recording in another format.

    Args:
        recording: the recording.
        path: of the main file; other files of the export lie beside it and begin with its name. The format's
            own end is added where the path does not have it.
        to: a name of `EXPORTS`.

    Returns:
        All files written, the main one first.

    Raises:
        FormatError: there is no such format, its package is missing, or it cannot hold the recording.
        FileNotFoundError: there is no such folder.
        OSError: the disk is full, or a link, device or folder has a name; files appear all together or not at all.
    """
    if to not in EXPORTS:
        raise FormatError(f"export: there is no format {to!r}; known are {', '.join(EXPORTS)}")
    suffix, write = EXPORTS[to]
    path = Path(path)
    if not path.name.endswith(suffix):
        path = path.with_name(path.name + suffix)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: there is no directory {path.parent}; make it first")
    with written_together(path.parent) as scratch:
        try:
            written = write(scratch / path.name, recording)
        except FormatError as fault:  # says which file: the one that was asked for, not the one on the way to it
            raise FormatError(str(fault).replace(str(scratch / path.name), str(path))) from fault
        except OSError as fault:
            if fault.errno is None:
                raise
            raise OSError(fault.errno, fault.strerror, str(path)) from fault
    return [path.parent / file.name for file in written]
