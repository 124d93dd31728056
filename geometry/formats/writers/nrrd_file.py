"""NRRD sequences as of 3D Slicer, by pynrrd: velocity and the scalars beside it; LPS, mm, times in s."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geometry.formats.own.mark import MARK, marked
from geometry.formats.source import missing_extra
from geometry.recordings.recording import Recording

from .common import SCALARS, UNITS, VECTORS, lattice, scalar, vector


def write_nrrd(path: Path, recording: Recording) -> list[Path]:
    """`NAME.seq.nrrd` with the velocity and `NAME_mask.seq.nrrd`, ... with the other fields."""
    try:
        import nrrd
    except ImportError as fault:
        raise missing_extra(path, "pynrrd") from fault
    origin, spacing, _ = lattice(recording)
    stem = path.name.removesuffix(".nrrd").removesuffix(".seq")
    written = []
    for name in (*VECTORS, *SCALARS):
        is_vector = name in VECTORS
        field = vector(recording, name) if is_vector else scalar(recording, name)
        if field is None:
            continue
        values = field.transpose(0, 1, 4, 3, 2) if is_vector else field.transpose(0, 3, 2, 1)
        lead = 2 if is_vector else 1
        nothing = [np.full(3, np.nan)] * lead
        header = {
            "space": "left-posterior-superior",
            "kinds": ["list", *(["vector"] if is_vector else []), "domain", "domain", "domain"],
            "space directions": np.array([*nothing, *np.diag(1e3 * spacing)]),
            "space origin": 1e3 * origin,
            "space units": ["mm", "mm", "mm"],
            "encoding": "gzip",
            "axis 0 index type": "numeric",
            "axis 0 index unit": "s",
            "axis 0 index values": " ".join(repr(float(time)) for time in recording.time),
            "units of values": UNITS[name],
        }
        if name == "velocity":
            header[MARK] = marked(recording)
        target = path.with_name(f"{stem}{'' if name == 'velocity' else '_' + name}.seq.nrrd")
        nrrd.write(str(target), np.ascontiguousarray(values), header, index_order="F")
        written.append(target)
    return written
