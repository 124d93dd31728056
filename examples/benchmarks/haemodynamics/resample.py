"""The flow halfway between frames: by the model, and by straight and cubic lines in time.

    python examples/benchmarks/haemodynamics/resample.py TRUTH.h5 MEASURED.h5 [--every 2] [--particles M] [--members N]

Takes every `every`-th frame of the measurement, and compares what lies halfway between two of them with the true flow:

- `truth`: from the true flow at those frames, so that nothing but what lies in between is wrong;
- `spline`: from the splines of the measured frames;
- `ensemble`: from the analyses of the measured frames (with --members).

`nrmse` is over all moments halfway, `ratio` that of the model over the straight line's, `spread` the claimed deviation
over the error, both as root mean squares.
"""

from __future__ import annotations

import argparse
import json
import time as clock
from pathlib import Path

import numpy as np

import geometry
import torchsph as ts
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics.lagrangian.moving_flow import MovingFlow

RESULTS = Path(__file__).parents[1] / "results"


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
        claimed = sum(float((s.astype(float) ** 2)[:, m].sum()) for s, m in zip(claims, true.mask, strict=True))
        found["spread"] = float(np.sqrt(claimed / squares["model"].sum()))
    both = matching_frames(frames.time, truth.time, "the truth")
    at_frames = truth.select(both)
    error, size = (errors(list(field), at_frames) for field in (frames.velocity, 0 * frames.velocity))
    found["nrmse_at_frames"] = float(np.sqrt(error.sum() / size.sum()))
    return found


def errors(fields: list[np.ndarray], truth: geometry.Recording) -> np.ndarray:
    """Sum of squares over the true mask of each moment, m^2/s^2."""
    return np.array(
        [
            np.square((field - true).astype(np.float64))[:, mask].sum()
            for field, true, mask in zip(fields, truth.velocity, truth.mask, strict=True)
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path)
    parser.add_argument("--every", type=int, default=2, help="frames of the measurement")
    parser.add_argument("--particles", type=float, nargs="*", default=[], help="further spacings of particles, m")
    parser.add_argument("--members", type=int, default=0, help="of the ensemble; 0: no ensemble")
    parser.add_argument("--out", type=Path, default=RESULTS / "resample.json")
    args = parser.parse_args()
    truth, measured = (geometry.read_recording(path) for path in (args.truth, args.measured))
    frames = measured.select(slice(None, None, args.every))
    true = truth.select(matching_frames(frames.time, truth.time, "the truth"))
    step = float(min(frames.grid.spacing))
    results: dict[str, object] = {"interval": float(frames.time[1] - frames.time[0]), "torchsph": ts.__version__}

    def note(name: str, found: dict[str, object]) -> None:
        results[name] = found
        print(name, found["nrmse"], f"ratio {found['ratio']:.3f}", found.get("spread", ""), flush=True)
        args.out.write_text(json.dumps(results, indent=1) + "\n")

    for particles in (step, *args.particles):
        note(f"truth, particles of {1e3 * particles:g} mm", halfway(true, truth, particles))
    note("spline", halfway(ts.smooth(frames), truth, step))
    if args.members:
        done = ts.run_methods(frames, ["ensemble"], members=args.members)["ensemble"]
        note(f"ensemble of {args.members}", halfway(done.recording, truth, step))


if __name__ == "__main__":
    main()
