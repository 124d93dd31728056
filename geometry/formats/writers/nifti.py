"""NIfTI-1 by nibabel: velocity as a series of vectors, the scalars beside it; mm, s, RAS, m/s."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.formats.own.mark import MARK, marked
from geometry.formats.source import missing_extra
from geometry.recordings.recording import Recording

from .common import SCALARS, VECTORS, even_interval, lattice, scalar, vector

RAS = np.array([-1.0, -1.0, 1.0])  # from LPS, in which recordings of a patient are


def write_nifti(path: Path, recording: Recording) -> list[Path]:
    """`NAME.nii.gz` with the velocity, (x, y, z, t, 3), and `NAME_mask.nii.gz`, ... with the other fields."""
    try:
        import nibabel
    except ImportError as fault:
        raise missing_extra(path, "nibabel") from fault
    step = even_interval(recording, path, "vtkhdf, nrrd or netcdf")
    origin, spacing, _ = lattice(recording)
    affine = np.diag([*(1e3 * spacing * RAS), 1.0])
    affine[:3, 3] = 1e3 * origin * RAS
    stem = path.name.removesuffix(".gz").removesuffix(".nii")
    written = []
    for name in (*VECTORS, *SCALARS):
        if name in VECTORS:
            field = vector(recording, name)
            values = None if field is None else field.transpose(4, 3, 2, 0, 1) * (1 if name == "sigma" else RAS)
        else:
            field = scalar(recording, name)
            values = None if field is None else field.transpose(3, 2, 1, 0)
        if values is None:
            continue
        values = values.astype(np.uint8 if name == "mask" else np.float32)
        image = nibabel.Nifti1Image(values, affine)
        image.header.set_xyzt_units("mm", "sec")
        image.header["pixdim"][4] = step
        image.header["toffset"] = float(recording.time[0])
        if name in VECTORS:
            image.header.set_intent("vector", name="velocity m/s" if name == "velocity" else name)
        if name == "velocity":
            note = f"{MARK} {marked(recording)}".encode()
            image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", note))
        target = path.with_name(f"{stem}{'' if name == 'velocity' else '_' + name}.nii.gz")
        nibabel.save(image, target)
        written.append(target)
    return written
