"""NIfTI-1 and -2 images, by nibabel: 4-D series of a component, and images of vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.formats.source import FormatError, Source, missing_extra

LENGTHS = {"mm": 1e-3, "meter": 1.0, "micron": 1e-6}
TIMES = {"sec": 1.0, "msec": 1e-3, "usec": 1e-6}


def open_nifti(path: Path) -> Source:
    """One array, named after the file; coordinates are RAS, as the format says.

    An image without a unit of length is in mm, as the tools of the field take it.
    """
    try:
        import nibabel
        from nibabel.filebasedimages import ImageFileError
    except ImportError as fault:
        raise missing_extra(path, "nibabel") from fault
    try:
        image = nibabel.load(path)
    except ImageFileError as fault:
        raise FormatError(f"{path}: is no readable NIfTI file ({fault})") from fault
    name = path.name.removesuffix(".gz").removesuffix(".nii")
    shape = image.shape
    axes = "xyztc"[: len(shape)] if len(shape) <= 5 else ""
    length, times = image.header.get_xyzt_units()
    time = None
    if len(shape) > 3 and shape[3] > 1 and times in TIMES:
        step = float(image.header["pixdim"][4])
        time = (float(image.header["toffset"]) + step * np.arange(shape[3])) * TIMES[times]
    role = {"velocity": (name,)} if len(shape) == 5 and shape[4] == 3 else {}
    return Source(
        str(path),
        {name: image.dataobj},
        axes={name: axes},
        affine=np.asarray(image.affine, np.float64),
        length=LENGTHS.get(length, 1e-3),
        world="ras",
        time=time,
        roles=role,
    )
