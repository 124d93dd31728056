"""Make the sample that ships in the package from a true recording and its measurement.

    python examples/make_sample.py [FOLDER]

FOLDER holds `lv_phantom_a.h5` and `lv_phantom_a_measured.h5` (default: shared/data beside the checkout). The
stretch runs from late ejection over the closed ventricle and the opening of the mitral valve to the filling
jet half way to the apex, every phase within 16 measured frames of 10 ms. The truth keeps its 5 ms frames, so
that forecasts of 5 ms can be scored. Numbers are rounded to powers of two far below what they are good for:
gzip saves on trailing zero bits.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import geometry

FIRST, LAST = 0.190, 0.340  # s
LIMIT = 4_000_000  # bytes of both files together
TRUE_STEP = 2.0**-15  # m/s: a hundredth of a percent of the jet
MEASURED_STEP = 2.0**-13  # m/s: a two-hundredth of the measurement's smallest noise
WEIGHT_STEP = 2.0**-8
VERTEX_STEP = 2.0**-24  # m: 60 nm
WALL_STEP = 2.0**-15  # m/s


def rounded(values: np.ndarray | None, step: float) -> np.ndarray | None:
    """Values to the nearest multiple of a step."""
    return None if values is None else (np.round(np.asarray(values, np.float64) / step) * step).astype(values.dtype)


def stretch(recording: geometry.Recording, step: float) -> geometry.Recording:
    """The frames from FIRST to LAST, rounded, without the pressure (no part of the chain reads it)."""
    part = recording.select((recording.time > FIRST - 1e-6) & (recording.time < LAST + 1e-6))
    wall = replace(
        part.wall,
        vertices=rounded(part.wall.vertices, VERTEX_STEP),
        velocity=rounded(part.wall.velocity, WALL_STEP),
    )
    return replace(
        part,
        velocity=rounded(part.velocity, step),
        weight=rounded(part.weight, WEIGHT_STEP),
        wall=wall,
        pressure=None,
    )


def main(source: Path) -> None:
    """Write both files of the sample and say how large they are."""
    target = Path(__file__).resolve().parents[1] / "torchsph" / "data"
    total = 0
    for name, out, step in (
        ("lv_phantom_a.h5", "sample_true.h5", TRUE_STEP),
        ("lv_phantom_a_measured.h5", "sample_measured.h5", MEASURED_STEP),
    ):
        part = stretch(geometry.read_recording(source / name), step)
        geometry.write_recording(target / out, part)
        size = (target / out).stat().st_size
        total += size
        print(f"{target / out}: {part.frames} frames, {size / 1e6:.2f} MB")
    if total > LIMIT:
        sys.exit(f"the sample takes {total / 1e6:.2f} MB, more than {LIMIT / 1e6:g} MB: choose a shorter stretch")


if __name__ == "__main__":
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else default)
