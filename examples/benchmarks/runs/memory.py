"""Predicted against measured memory of whole runs, each in a process of its own.

    python examples/benchmarks/runs/memory.py [--quick] [--out memory.json] [N ...]

Prints, for each scene, what `torchsph.methods.memory` predicts beyond the process at its start, the peak of resident
memory that the run then added to it, their ratio, and the ratio of the whole processes' peaks. What reading the
recording has freed again is given back to the system first, or the run would fill it unseen.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT))

# what is run, recording, frames, particle spacing (m; None: the default), members
SCENES = (
    ("ensemble", "sample", 2, None, 3),
    ("spline", "sample", 3, None, 0),
    ("free", "sample", 3, None, 0),
    ("forecast", "sample", 3, None, 0),
    ("ensemble", "sample", 8, None, 16),
    ("ensemble", "sample", 2, 1.5e-3, 16),
    ("ensemble", "sample", 2, 1e-3, 16),
    ("ensemble", "phantom", 3, None, 16),
    ("ensemble", "plane", 2, None, 8),
    ("ensemble", "box", 2, None, 4),
    ("spline", "phantom", 3, None, 0),
    ("free", "phantom", 3, None, 0),
    ("forecast", "phantom", 3, None, 0),
    ("forecast", "sample", 3, 1e-3, 0),
    ("forecast", "phantom", 3, 1e-3, 0),
    ("ensemble", "phantom", 2, 1e-3, 16),
)


def scene(name: str, frames: int):
    """A stretch of the sample or the phantom, a plane of 100 x 100 nodes, or a cube of 24."""
    import geometry
    from torchsph.data import sample_measurement

    if name in ("sample", "phantom"):
        phantom = ROOT.parent / "shared" / "data" / "lv_phantom_a_measured.h5"
        path, first = (sample_measurement(), 8) if name == "sample" else (phantom, 20)
        return geometry.read_recording(path).select(slice(first, first + frames))
    sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "support")]
    from conftest import box_recording

    dimension, nodes = (2, 100) if name == "plane" else (3, 24)
    size, noise = nodes * 1e-3, np.random.default_rng(0)

    def flow(points: np.ndarray, _: float) -> np.ndarray:
        return 0.1 * np.sin(2 * np.pi * points[:, ::-1] / size) + noise.normal(0.0, 0.01, points.shape)

    return box_recording(flow, dimension=dimension, size=size, nodes=nodes, times=tuple(0.005 * np.arange(frames)))


def forget_peak() -> None:
    """Give freed memory back, and let the peak be what is resident now."""
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak() -> int:
    """Bytes of resident memory at most since the peak was forgotten."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))


def run(method: str, name: str, frames: int, spacing: float | None, members: int) -> dict[str, float]:
    """One scene in this process."""
    from torchsph.methods import by_name
    from torchsph.methods.measurement.prepared import PreparedMeasurement

    measured = scene(name, frames)
    forget_peak()
    start = peak()
    if method == "forecast":
        leads = np.diff(measured.time)[:1].tolist()
        foretold = by_name.predicted_forecast_memory(measured, spacing=spacing).total
        by_name.forecast_skill(measured, leads, spacing=spacing)
    else:
        options = {"spacing": spacing} | ({"members": members} if members else {})
        foretold = by_name.predicted_memory(PreparedMeasurement(measured), (method,), **options).total
        by_name.run_methods(measured, (method,), **options)
    return {"start": start, "predicted": foretold, "measured": peak() - start}


def main() -> None:
    """Run the scenes, or those of the numbers given, one after another and print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("scenes", nargs="*", type=int, metavar="N", help="numbers of scenes, from 0 (all)")
    parser.add_argument("--out", type=Path, help="the rows, JSON")
    parser.add_argument("--quick", action="store_true", help="the first four, on the sample")
    parser.add_argument("--scene", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.scene is not None:
        print(json.dumps(run(*SCENES[args.scene])))
        return
    heads = f"{'predicted MB':>12} {'measured MB':>11} ratio  whole"
    print(f"{'run':8} {'scene':8} {'frames':>6} {'spacing':>8} {'members':>7} {heads}")
    rows = []
    for number in args.scenes or range(4 if args.quick else len(SCENES)):
        call = [sys.executable, "-W", "ignore", __file__, "--scene", str(number)]
        found = json.loads(subprocess.run(call, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        method, name, frames, spacing, members = SCENES[number]
        ratio = found["predicted"] / found["measured"]
        whole = (found["start"] + found["predicted"]) / (found["start"] + found["measured"])
        told = f"{method:8} {name:8} {frames:6} {spacing or '-':>8} {members:7} {found['predicted'] / 1e6:12.0f}"
        print(f"{told} {found['measured'] / 1e6:11.0f} {ratio:5.2f}  {whole:5.2f}", flush=True)
        about = {"run": method, "scene": name, "frames": frames, "spacing": spacing, "members": members}
        sizes = {f"{part}_MB": round(found[part] / 1e6, 1) for part in ("predicted", "measured")}
        rows.append({**about, **sizes, "ratio": round(ratio, 3), "whole": round(whole, 3)})
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
