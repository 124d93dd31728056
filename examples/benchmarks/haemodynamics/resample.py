"""The flow halfway between frames: by the model, and by straight and cubic lines in time.

    python examples/benchmarks/haemodynamics/resample.py TRUTH.h5 MEASURED.h5 [--every 2] [--particles M] [--members N]
        [--run FOLDER] [--between S S] [--only NAME ...]

Takes every `every`-th frame of the measurement, and compares what lies halfway between two of them with the true flow:

- `truth`: from the true flow at those frames, so that nothing but what lies in between is wrong;
- `spline`: from the splines of the measured frames;
- `ensemble`: from the analyses of the measured frames (with --members);
- `analysis`: from the analysis of all frames that `torchsph assimilate` has left in a folder (with --run), or of those
  between two times.

`nrmse` is over all moments halfway, `ratio` that of the model over the straight line's, `spread` the claimed deviation
over the error, both as root mean squares, `holds` the share of true velocity components within 1.645 claimed
deviations, which is .90 where errors are as claimed and Gaussian; `at frames` says both of the frames themselves. Rows
that the file has and that are not asked for stay.
"""

from __future__ import annotations

import argparse
import json
import sys
import time as clock
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np

import geometry
import torchsph as ts
from examples.provenance import ANALYSES, write_table
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics.lagrangian.moving_flow import MovingFlow

RESULTS = Path(__file__).parents[1] / "results"
SOURCES = ("examples/benchmarks/haemodynamics/resample.py", *ANALYSES, "torchsph/haemodynamics")
BAND = 1.645  # deviations: nine in ten of a normal distribution


def halfway(frames: geometry.Recording, truth: geometry.Recording, particles: float | None) -> dict[str, object]:
    """Errors of the three ways at the moments halfway between `frames`."""
    times = 0.5 * (frames.time[1:] + frames.time[:-1])
    true = truth.select(matching_frames(times, truth.time, "the truth"))
    began = clock.perf_counter()
    flow = ts.BetweenFrames(frames, ts.make_model(frames, spacing=particles))
    moments = list(flow.moments(times, frames.grid))
    seconds = clock.perf_counter() - began
    valves = frames.valve_intervals_or_derived()[:, 1:]
    events = [float(t) for t in np.unique(valves) if np.isfinite(t)]
    fields = {"model": [one.velocity for one in moments]}
    for way in ("linear", "cubic"):
        line = MovingFlow(frames.grid, frames.time, filled_velocity(frames), frames.mask, in_time=way, events=events)
        fields[way] = [line.field(float(t)).numpy() for t in times]
    squares = {name: errors(found, true) for name, found in fields.items()}
    size = errors([np.zeros_like(field) for field in fields["model"]], true)
    found: dict[str, object] = {
        "nrmse": {name: float(np.sqrt(square.sum() / size.sum())) for name, square in squares.items()},
        "ratio": float(np.sqrt(squares["model"].sum() / squares["linear"].sum())),
        "ratio_to_cubic": float(np.sqrt(squares["model"].sum() / squares["cubic"].sum())),
        "per_moment": {name: np.sqrt(square / size).tolist() for name, square in squares.items()},
        "times": times.tolist(),
        "seconds": seconds,
        "failures": len(flow.failures),
    }
    claims = [one.sigma for one in moments if one.sigma is not None]
    if claims:
        found |= calibration(fields["model"], claims, true)
    at_frames = truth.select(matching_frames(frames.time, truth.time, "the truth"))
    error, size = (errors(list(field), at_frames) for field in (frames.velocity, 0 * frames.velocity))
    found["nrmse_at_frames"] = float(np.sqrt(error.sum() / size.sum()))
    if frames.sigma is not None:
        found["at frames"] = calibration(list(frames.velocity), list(frames.sigma), at_frames)
    return found


def calibration(fields: list[np.ndarray], claims: list[np.ndarray], truth: geometry.Recording) -> dict[str, float]:
    """Claimed deviations over errors, and how many true components a band of nine in ten holds."""
    claimed, held, count = 0.0, 0, 0
    for field, sigma, true, mask in zip(fields, claims, truth.velocity, truth.mask, strict=True):
        deviation, error = (each.astype(np.float64)[:, mask] for each in (sigma, field - true))
        claimed += float((deviation**2).sum())
        held += int((np.abs(error) < BAND * deviation).sum())
        count += error.size
    return {"spread": float(np.sqrt(claimed / errors(fields, truth).sum())), "holds": held / count}


def errors(fields: list[np.ndarray], truth: geometry.Recording) -> np.ndarray:
    """Sum of squares over the true mask of each moment, m^2/s^2."""
    return np.array(
        [
            np.square((field - true).astype(np.float64))[:, mask].sum()
            for field, true, mask in zip(fields, truth.velocity, truth.mask, strict=True)
        ]
    )


def main() -> None:
    """Make the rows asked for, print them, write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path)
    parser.add_argument("--every", type=int, default=2, help="frames of the measurement")
    parser.add_argument("--particles", type=float, nargs="*", default=[], help="further spacings of particles, m")
    parser.add_argument("--members", type=int, default=0, help="of the ensemble; 0: no ensemble")
    parser.add_argument("--run", type=Path, help="folder with an analysis of all frames")
    parser.add_argument("--between", type=float, nargs=2, metavar="S", help="of the analysis's frames these alone")
    parser.add_argument("--only", nargs="*", choices=("truth", "spline", "ensemble", "analysis"), help="these alone")
    parser.add_argument("--out", type=Path, default=RESULTS / "resample.json")
    args = parser.parse_args()
    wanted = args.only or ("truth", "spline", "ensemble", "analysis")
    truth, measured = (geometry.read_recording(path) for path in (args.truth, args.measured))
    frames = measured.select(slice(None, None, args.every))
    true = truth.select(matching_frames(frames.time, truth.time, "the truth"))
    step = float(min(frames.grid.spacing))
    results = json.loads(args.out.read_text(encoding="utf-8")) if args.out.is_file() else {}
    results |= {"interval": float(frames.time[1] - frames.time[0]), "torchsph": ts.__version__}

    def note(name: str, found: dict[str, object]) -> None:
        results[name] = found
        print(name, found["nrmse"], f"ratio {found['ratio']:.3f}", found.get("spread", ""), found.get("holds", ""))
        write_table(args.out, results, SOURCES)

    for particles in (step, *args.particles) if "truth" in wanted else ():
        note(f"truth, particles of {1e3 * particles:g} mm", halfway(true, truth, particles))
    if "spline" in wanted:
        note("spline", halfway(ts.smooth(frames), truth, step))
    if args.members and "ensemble" in wanted:
        done = ts.run_methods(frames, ["ensemble"], members=args.members)["ensemble"]
        note(f"ensemble of {args.members}", halfway(done.recording, truth, step))
    if args.run and "analysis" in wanted:
        whole = geometry.read_recording(args.run / "ensemble.h5")
        first, last = args.between or whole.time[[0, -1]]
        kept = whole.select((whole.time > first - 1e-6) & (whole.time < last + 1e-6))
        note(f"analysis, {1e3 * first:.0f} to {1e3 * last:.0f} ms", halfway(kept, truth, step))


if __name__ == "__main__":
    main()
