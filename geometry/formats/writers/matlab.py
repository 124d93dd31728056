"""MATLAB version 5 files by SciPy: fields as (x, y, z, t), places in m, times in s, faces counted from 1."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.formats.own.mark import MARK, marked
from geometry.formats.source import FormatError
from geometry.recordings.recording import Recording

from .common import SCALARS, VECTORS, lattice, scalar, vector, wall_velocity

LARGEST = 2**31 - 1  # bytes of one variable


def write_matlab(path: Path, recording: Recording) -> list[Path]:
    """`u`, `v`, `w`, `mask`, `x`, `y`, `z`, `t`, `wall` and what else the recording holds, SI units."""
    from scipy.io import savemat

    origin, spacing, counts = lattice(recording)
    content: dict[str, object] = {
        letter: origin[axis] + spacing[axis] * np.arange(counts[axis]) for axis, letter in enumerate("xyz")
    }
    content |= {"t": recording.time, "rho": recording.rho, "mu": recording.mu, "period": recording.period}
    content["units"] = "x, y, z: m; t: s; u, v, w, sigma: m/s; pressure: Pa; arrays run (x, y, z, t)"
    for name in VECTORS:
        field = vector(recording, name)
        if field is None:
            continue
        for component in range(3):
            label = "uvw"[component] if name == "velocity" else f"{name}_{'xyz'[component]}"
            content[label] = field[:, component].transpose(3, 2, 1, 0)
    for name in SCALARS:
        values = scalar(recording, name)
        if values is not None:
            content[name] = values.transpose(3, 2, 1, 0)
    if recording.wall is not None:
        wall = recording.wall
        content["wall"] = {
            "vertices": np.moveaxis(np.atleast_3d(wall.vertices), 0, -1) if wall.moves else wall.vertices,
            "faces": wall.faces.astype(np.float64) + 1,
            "region": wall.region,
            "velocity": np.moveaxis(wall_velocity(wall, recording.time), 0, -1),
        }
    content[MARK] = marked(recording)
    largest = max((value.nbytes for value in content.values() if isinstance(value, np.ndarray)), default=0)
    if largest > LARGEST:
        raise FormatError(
            f"{path}: a variable of {largest / 2**30:.2g} GiB is more than the format holds; use netcdf or npz"
        )
    savemat(path, content, do_compression=True)
    return [path]
