"""NumPy archives: the arrays of the recording file under its names, SI units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geometry.formats.own.mark import FIELDS, MARK, marked
from geometry.recordings.recording import Recording


def write_npz(path: Path, recording: Recording) -> list[Path]:
    """`velocity`, `mask`, `time`, `wall_vertices`, ...; `origin` and `spacing` along x, y, z."""
    content: dict[str, Any] = {name.strip("/").replace("/", "_"): values for name, values in recording.arrays().items()}
    content |= {name: np.float64(getattr(recording, name)) for name in ("rho", "mu", "period")}
    content |= {"origin": np.array(recording.grid.origin), "spacing": np.array(recording.grid.spacing)}
    content[MARK] = np.array(marked(recording, [name for name in FIELDS if name not in ("beam", "normal")]))
    np.savez_compressed(path, **content)
    return [path]
