"""How well the speckle tracker works: bias and deviation against everything that makes it worse.

    python examples/benchmarks/ultrasound/tracking.py [PART ...] [--quick] [--out FOLDER] [--json FILE]

Parts: speed angle shear snr clutter dropout memory calibration response; without names all of them (ten
minutes on one quiet core). Uniform or sheared motion of 5 MHz echoes, point spread 0.5 mm axial and 1.2 mm across
(FWHM), PRF 4 kHz, packet of 16, SNR 20 dB unless it is what varies; kernel of 1 mm, 7 x 7 x 7, +-1 m/s (table 3.1
of the thesis), 343 points 1 mm apart per simulation. Velocities in m/s; x, y across the beam and z along it.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import torch

from examples.provenance import TRACKING, write_table
from geometry import Grid
from torchsph.ultrasound import (
    EchoModel,
    FIRFilter,
    LinearFlow,
    PolynomialFilter,
    SpeckleTracker,
    SVDFilter,
    TrainingPlan,
    calibrate,
    random_scene,
    simulate_packet,
)
from torchsph.ultrasound.measurements.training import training_points

SOURCES = ("examples/benchmarks/ultrasound/tracking.py", *TRACKING)

STEP = 1e-3 / 6
CENTRE = (0.0, 0.0, 24e-3)
OUTLIER = 0.3  # m/s off and yet accepted
COMPONENTS = ("x (across)", "y (across)", "z (along)")
Rows = dict[str, dict]


def image_grid(half: int) -> Grid:
    return Grid(tuple(c - half * STEP for c in CENTRE), (STEP,) * 3, (2 * half + 1,) * 3)


def lattice(half: int) -> torch.Tensor:
    axis = torch.arange(-half, half + 1, dtype=torch.float64) * 1e-3
    return torch.cartesian_prod(axis, axis, axis) + torch.tensor(CENTRE, dtype=torch.float64)


def errors(velocity, tracker, seeds, *, gradient=None, half=3, margin=6, **model):
    """Errors (seeds, points, 3), m/s, and accepted (seeds, points) on uniform or sheared motion."""
    points, grid = lattice(half), image_grid(6 * half + margin)
    flow = LinearFlow(tuple(velocity), gradient, CENTRE)
    off, accepted = [], []
    for seed in range(seeds):
        packet = simulate_packet(flow, grid, EchoModel(**model), 0.0, torch.Generator().manual_seed(seed))
        found = tracker.track(packet, points)
        off.append(found.velocity - flow.velocity(points, 0.0).float())
        accepted.append(found.accepted)
    return torch.stack(off), torch.stack(accepted)


def summary(error: torch.Tensor, accepted: torch.Tensor) -> dict:
    """Bias, deviation, median size per component, share of outliers and of accepted points."""
    kept = error[accepted]
    row = {"accepted": round(float(accepted.float().mean()), 4), "points": len(kept)}
    if len(kept) < 10:
        return row
    statistics = {"bias": kept.mean(0), "std": kept.std(0), "median": kept.abs().median(0).values}
    row |= {name: [round(v, 5) for v in values.tolist()] for name, values in statistics.items()}
    return row | {"outliers": round(float((kept.norm(dim=1) > OUTLIER).float().mean()), 4)}


def show(label: str, row: dict) -> dict:
    numbers = "".join(
        f"  {name} " + " ".join(f"{v:+.4f}" for v in row[name]) for name in ("bias", "std") if name in row
    )
    outliers = f"  outliers {row['outliers']:.3f}" if "outliers" in row else ""
    print(f"{label:34s} accepted {row['accepted']:.3f}{numbers}{outliers}", flush=True)
    return row


def sweep(values: list, label: str, run: Callable[[float], tuple]) -> Rows:
    return {str(value): show(f"{label} {value}", summary(*run(value))) for value in values}


def lateral(speed: float, angle: float) -> tuple[float, float, float]:
    """A velocity ``angle`` degrees off the beam; its lateral part points between x and y."""
    across = speed * math.sin(math.radians(angle))
    return 0.8 * across, 0.6 * across, speed * math.cos(math.radians(angle))


def speed(quick: bool) -> Rows:
    """Speeds at 60 degrees to the beam; none is a whole number of nodes per image."""
    tracker, values = SpeckleTracker(clutter=None), [0.3] if quick else [0.1, 0.3, 0.5, 0.7, 0.9]
    return sweep(values, "speed", lambda v: errors(lateral(v, 60), tracker, 1 if quick else 5))


def angle(quick: bool) -> Rows:
    """Directions at 0.6 m/s."""
    tracker, values = SpeckleTracker(clutter=None), [90] if quick else [0, 30, 60, 90]
    return sweep(values, "angle", lambda a: errors(lateral(0.6, a), tracker, 1 if quick else 5))


def shear(quick: bool) -> dict[str, Rows]:
    """Axial velocity changing across the beam, with and without the clutter filter."""
    rows, values = {}, [0, 200] if quick else [0, 25, 50, 100, 150, 200]
    for name, clutter in (("none", None), ("FIR", FIRFilter())):
        tracker = SpeckleTracker(clutter=clutter)

        def run(rate: float, tracker: SpeckleTracker = tracker) -> tuple:
            return errors((0.2, 0.1, 0.25), tracker, 1 if quick else 3, gradient=((0,) * 3, (0,) * 3, (rate, 0, 0)))

        rows[name] = sweep(values, f"{name}: shear (1/s)", run)
    return rows


def snr(quick: bool) -> Rows:
    tracker, values = SpeckleTracker(clutter=None, min_snr=None), [0] if quick else [-6, 0, 6, 12, 20, 30]
    return sweep(values, "SNR (dB)", lambda s: errors((0.32, 0.2, 0.26), tracker, 1 if quick else 3, snr=float(s)))


def clutter(quick: bool) -> dict[str, Rows]:
    """Echoes of tissue over blood, moving by 1 cm/s, removed by each kind of filter (still ones leave no trace)."""
    rows, values = {}, [40] if quick else [0, 10, 20, 30, 40]
    for name, filtering in (("FIR", FIRFilter()), ("polynomial", PolynomialFilter(2)), ("SVD", SVDFilter(1))):
        tracker = SpeckleTracker(clutter=filtering, max_snr=26.0)

        def run(level: float, tracker: SpeckleTracker = tracker) -> tuple:
            model = {"clutter": float(level), "clutter_velocity": (0.0, 0.0, 0.01)}
            return errors((0.32, 0.2, 0.2), tracker, 1 if quick else 2, **model)

        rows[name] = sweep(values, f"{name}: clutter (dB)", run)
    return rows


def dropout(quick: bool) -> Rows:
    """Acceptance and error against axial speed after the FIR filter, clutter 40 dB."""
    tracker = SpeckleTracker()
    values = [0.0, 0.2] if quick else [0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.45, 0.6]
    return sweep(values, "axial (m/s)", lambda v: errors((0.2, 0.1, v), tracker, 1 if quick else 2, clutter=40.0))


def memory(quick: bool) -> dict[str, dict[int, float]]:
    """Autocorrelation of the lateral error at 1 to 7 mm, for kernels of 1, 2 and 3 mm."""
    rows, half = {}, 2 if quick else 5
    side = 2 * half + 1
    for kernel in (1e-3, 2e-3, 3e-3):
        tracker = SpeckleTracker(clutter=None, kernel=kernel, lags=(1,))
        error, accepted = errors((0.32, 0.2, 0.26), tracker, 1 if quick else 3, half=half, margin=13)
        field = torch.where(accepted[..., None], error - error[accepted].mean(0), 0)[..., 0].view(-1, *(side,) * 3)
        rows[f"{kernel * 1e3:g} mm"] = {
            lag: round(float((field[:, :, :, lag:] * field[:, :, :, :-lag]).mean() / field.square().mean()), 3)
            for lag in range(1, min(8, side))
        }
    print("error autocorrelation by lag (mm):", rows, flush=True)
    return rows


def terciles(score: torch.Tensor, weight: torch.Tensor) -> dict[str, list[float]]:
    """Root mean square of z-scores (n, 3) in each third of the weight (n,), lowest weight first."""
    thirds = [score[third] for third in weight.argsort().tensor_split(3)]
    rms = {
        "all": [part.square().mean().sqrt() for part in thirds],
        "across": [part[:, :2].square().mean().sqrt() for part in thirds],
        "along": [part[:, 2].square().mean().sqrt() for part in thirds],
    }
    return {name: [round(float(v), 3) for v in values] for name, values in rms.items()}


def calibration(quick: bool) -> dict:
    """z-scores with sigma and weight fitted on other simulations: other seeds and speeds."""
    model, tracker, spacing = EchoModel(), SpeckleTracker(max_snr=26.0), (STEP,) * 3
    plan = TrainingPlan(simulations=4) if quick else TrainingPlan()
    fitted = calibrate(model, tracker, spacing, torch.Generator().manual_seed(0), plan)
    lattice, grid = training_points(plan, (0.0,) * 3), Grid((-33 * STEP,) * 3, spacing, (67,) * 3)
    scores, weights = [], []
    for seed, rms in enumerate((0.2,) if quick else (0.08, 0.12, 0.18, 0.25, 0.33, 0.4) * 4, 100):
        generator = torch.Generator().manual_seed(seed)
        flow = random_scene((0.0,) * 3, plan.half, rms, generator, tissue_speed=plan.tissue_speed)
        points = lattice[flow.blood(lattice, 0.0)]
        found = tracker.track(simulate_packet(flow, grid, model, 0.0, generator), points)
        beam = model.beams.directions(points).float()
        score = (found.velocity - flow.velocity(points, 0.0).float()) / fitted.sigma(found, beam)
        scores.append(score[found.accepted])
        weights.append(fitted.weight(found, beam)[found.accepted])
    rows = terciles(torch.cat(scores), torch.cat(weights)) | {"points": sum(map(len, scores))}
    print("z-scores by third of the weight:", rows, flush=True)
    return rows


def response(quick: bool) -> dict:
    """Power response of the clutter filters, dB, at some frequencies in units of the PRF."""
    frequency = np.array([0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5])
    filters = {"FIR": FIRFilter().response(frequency)}
    filters |= {f"polynomial {order}": PolynomialFilter(order).response(frequency) for order in (2, 3)}
    rows = {name: [round(float(v), 1) for v in decibel(power)] for name, power in filters.items()}
    print("response (dB):", rows)
    return {"frequency": frequency.tolist(), **rows}


def decibel(power: np.ndarray) -> np.ndarray:
    return 10 * np.log10(np.maximum(power, 1e-12))


PARTS = {part.__name__: part for part in (speed, angle, shear, snr, clutter, dropout, memory, calibration, response)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all without")
    parser.add_argument("--quick", action="store_true", help="one simulation of few cases: does it run?")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="draw the figures into this folder")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here, adding to what is there")
    arguments = parser.parse_args()
    unknown = set(arguments.parts) - set(PARTS)
    if unknown:
        parser.error(f"no part named {', '.join(sorted(unknown))}")
    results = {}
    if arguments.json and arguments.json.is_file():
        results = json.loads(arguments.json.read_text())
    for name in arguments.parts or PARTS:
        print(f"-- {name}", flush=True)
        results[name] = PARTS[name](arguments.quick)
        if arguments.json:
            write_table(arguments.json, results, SOURCES)
    if arguments.out:
        from tracking_figures import draw_errors, draw_response

        arguments.out.mkdir(parents=True, exist_ok=True)
        draw_errors(json.loads(json.dumps(results)), arguments.out / "tracking.png")
        draw_response(arguments.out / "tracking_clutter_filter.png")


if __name__ == "__main__":
    main()
