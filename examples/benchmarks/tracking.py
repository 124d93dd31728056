"""How well and how fast the speckle tracker works: tables, figures, and comparisons in one run.

    python examples/benchmarks/tracking.py --out build/tracking [uniform shear snr clutter dropout memory
    speed response]

Without names every part runs (about ten minutes on one core). OpenPIV joins the speed table where it is
installed. System: 5 MHz, point spread 0.5 mm axial and 1.2 mm across (FWHM), PRF 4 kHz, packet of 16;
kernel of 1 mm, 7 x 7 x 7.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy.signal import correlate as scipy_correlate

from geometry import Grid
from torchsph.ultrasound import (
    EchoModel,
    FIRFilter,
    LinearFlow,
    PolynomialFilter,
    SpeckleTracker,
    simulate_packet,
)

STEP = 1e-3 / 6
CENTRE = (0.0, 0.0, 24e-3)


def image_grid(half: int) -> Grid:
    return Grid(tuple(c - half * STEP for c in CENTRE), (STEP,) * 3, (2 * half + 1,) * 3)


def lattice(half: int) -> torch.Tensor:
    axis = torch.arange(-half, half + 1, dtype=torch.float64) * 1e-3
    return torch.cartesian_prod(axis, axis, axis) + torch.tensor(CENTRE, dtype=torch.float64)


def errors(velocity, tracker, *, gradient=None, seeds=4, half=3, margin=6, **model):
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
    """Bias, deviation, median size per component (m/s); outliers: accepted but 0.3 m/s off or more."""
    kept = error[accepted]
    if len(kept) < 10:
        return {"accepted": float(accepted.float().mean()), "points": len(kept)}
    return {
        "accepted": round(float(accepted.float().mean()), 4), "points": len(kept),
        "bias": [round(v, 5) for v in kept.mean(0).tolist()],
        "std": [round(v, 5) for v in kept.std(0).tolist()],
        "median": [round(v, 5) for v in kept.abs().median(0).values.tolist()],
        "outliers": round(float((kept.norm(dim=1) > 0.3).float().mean()), 4),
    }  # fmt: skip


def show(label: str, row: dict) -> dict:
    if "bias" in row:
        numbers = "  ".join(f"{name} " + " ".join(f"{v:+.4f}" for v in row[name]) for name in ("bias", "std"))
        print(
            f"{label:34s} accepted {row['accepted']:.3f}  {numbers}  outliers {row['outliers']:.3f}",
            flush=True,
        )
    else:
        print(f"{label:34s} accepted {row['accepted']:.3f}", flush=True)
    return row


def uniform(out: Path) -> dict:
    """Speeds and angles at SNR 20 dB without clutter, off-integer shifts."""
    tracker, rows = SpeckleTracker(clutter=None), {}
    for speed in (0.1, 0.3, 0.6, 0.9):
        for angle in (30, 60, 90):
            lateral, axial = speed * math.sin(math.radians(angle)), speed * math.cos(math.radians(angle))
            velocity = (lateral * 0.8, lateral * 0.6, axial)
            label = f"{speed} m/s at {angle} degrees to the beam"
            rows[label] = show(label, {"velocity": velocity, **summary(*errors(velocity, tracker, seeds=6))})
    return rows


def sweep(title: str, unit: str, values: list, run: Callable, out: Path) -> dict:
    """One row per value, and a figure of deviation and acceptance."""
    rows = {str(value): show(f"{title} {value} {unit}", summary(*run(value))) for value in values}
    good = [v for v in values if "std" in rows[str(v)]]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), constrained_layout=True)
    for component, name in enumerate(("x (lateral)", "y (lateral)", "z (axial)")):
        axes[0].semilogy(good, [rows[str(v)]["std"][component] for v in good], "o-", label=name)
        axes[1].plot(good, [rows[str(v)]["bias"][component] for v in good], "o-", label=name)
    for axis, what in zip(axes, ("standard deviation (m/s)", "bias (m/s)"), strict=True):
        axis.set(xlabel=f"{title} ({unit})", ylabel=what)
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(out / f"tracking_{title.split()[0].lower()}.png", dpi=130)
    plt.close(figure)
    return rows


def shear(out: Path) -> dict:
    """Axial velocity changing across the beam, with and without the clutter filter."""
    rows = {}
    for name, clutter in (("unfiltered", None), ("FIR", FIRFilter())):
        tracker = SpeckleTracker(clutter=clutter)

        def run(rate: float, tracker: SpeckleTracker = tracker) -> tuple:
            return errors((0.2, 0.1, 0.25), tracker, gradient=((0,) * 3, (0,) * 3, (rate, 0, 0)), seeds=3)

        rows[name] = sweep(f"shear_{name}", "1/s", [0, 25, 50, 100, 200], run, out)
    return rows


def snr(out: Path) -> dict:
    tracker = SpeckleTracker(clutter=None, min_snr=None)
    return sweep(
        "SNR",
        "dB",
        [-6, 0, 6, 12, 20, 30],
        lambda s: errors((0.32, 0.2, 0.26), tracker, snr=float(s), seeds=3),
        out,
    )


def clutter(out: Path) -> dict:
    rows = {}
    for name, filtering in (("FIR", FIRFilter()), ("polynomial", PolynomialFilter(2))):
        tracker = SpeckleTracker(clutter=filtering)
        rows[name] = sweep(
            f"clutter_{name}", "dB", [0, 10, 20, 30, 40],
            lambda level, t=tracker: errors((0.32, 0.2, 0.2), t, clutter=float(level), seeds=3), out,
        )  # fmt: skip
    return rows


def dropout(out: Path) -> dict:
    """Acceptance and error against axial speed after the FIR filter, clutter 40 dB."""
    tracker = SpeckleTracker()
    speeds = [0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.45, 0.6]
    rows = {
        str(v): show(f"axial {v} m/s", summary(*errors((0.2, 0.1, v), tracker, clutter=40.0, seeds=2)))
        for v in speeds
    }
    figure, axis = plt.subplots(figsize=(5, 3.4), constrained_layout=True)
    axis.plot(speeds, [rows[str(v)]["accepted"] for v in speeds], "o-")
    axis.set(xlabel="axial speed (m/s)", ylabel="accepted share", ylim=(0, 1.05))
    axis.grid(alpha=0.3)
    figure.savefig(out / "tracking_dropout.png", dpi=130)
    plt.close(figure)
    return rows


def memory(out: Path) -> dict:
    """Autocorrelation of the lateral error at 1 to 5 mm, for kernels of 1 and 3 mm."""
    rows = {}
    for kernel in (1e-3, 3e-3):
        tracker = SpeckleTracker(clutter=None, kernel=kernel)
        error, accepted = errors((0.32, 0.2, 0.26), tracker, seeds=5, margin=16)
        field = torch.where(accepted[..., None], error - error[accepted].mean(0), 0)[..., 0].view(-1, 7, 7, 7)
        variance = float(field.square().mean())
        rows[f"{kernel * 1e3:g} mm"] = {
            lag: round(float((field[:, lag:] * field[:, :-lag]).mean()) / variance, 3) for lag in range(1, 6)
        }
    print("error autocorrelation by lag (mm):", rows)
    return rows


def plain_scipy(packet, points: torch.Tensor, search: int = 2, half: int = 3) -> np.ndarray:
    """The same search point by point and pair by pair with scipy.signal.correlate: lags (n, 3) in nodes."""
    images = packet.iq.numpy()
    nodes = packet.grid.locate(points).round().long().flip(-1).numpy()
    ones, found = np.ones((2 * half + 1,) * 3), np.zeros((len(points), 3))
    for number, (z, y, x) in enumerate(nodes):
        total, first_energy, second_energy = 0.0, 0.0, 0.0
        for first, second in zip(images[:-1], images[1:], strict=True):
            kernel = first[z - half : z + half + 1, y - half : y + half + 1, x - half : x + half + 1]
            reach = half + search
            region = second[z - reach : z + reach + 1, y - reach : y + reach + 1, x - reach : x + reach + 1]
            total = total + scipy_correlate(region, kernel, mode="valid", method="direct")
            first_energy += (np.abs(kernel) ** 2).sum()
            second_energy = second_energy + scipy_correlate(
                np.abs(region) ** 2, ones, mode="valid", method="direct"
            )
        rho = np.abs(total) / np.sqrt(first_energy * second_energy)
        peak = np.array(np.unravel_index(rho.argmax(), rho.shape))
        centre = peak.clip(1, 2 * search - 1)
        for axis in range(3):
            line = [rho[tuple(centre + step * np.eye(3, dtype=int)[axis])] for step in (-1, 0, 1)]
            bend = line[0] - 2 * line[1] + line[2]
            found[number, axis] = centre[axis] - search + (0.5 * (line[0] - line[2]) / bend if bend else 0.0)
    return found


def seconds(run: Callable) -> float:
    """The shorter of two runs: the machine may be shared."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def speed(out: Path) -> dict:
    """Milliseconds per point: ours (search alone, and with refinements), plain SciPy, OpenPIV."""
    points, grid = lattice(6), image_grid(42)
    packet = simulate_packet(
        LinearFlow((0.3, 0.2, 0.25)), grid, EchoModel(), 0.0, torch.Generator().manual_seed(0)
    )
    search = SpeckleTracker(clutter=None, lags=(1,), follow_shear=False)
    few = points[:: len(points) // 24]
    rows = {
        "ours, same search": 1e3 * seconds(lambda: search.track(packet, points)) / len(points),
        "ours, with refinements": 1e3
        * seconds(lambda: SpeckleTracker(clutter=None).track(packet, points))
        / len(points),
        "plain SciPy, same search": 1e3 * seconds(lambda: plain_scipy(packet, few)) / len(few),
    }
    try:
        from openpiv.pyprocess3D import extended_search_area_piv3D
    except ImportError:
        print("OpenPIV is not installed: left out")
    else:
        frames = packet.iq.abs().numpy().astype(np.float64)
        count = []

        def openpiv() -> None:
            for first, second in zip(frames[:3], frames[1:4], strict=False):
                sizes = {"window_size": (7,) * 3, "overlap": (1,) * 3, "search_area_size": (11,) * 3}
                found = extended_search_area_piv3D(first, second, **sizes)
                count.append(np.asarray(found[0]).size)

        rows["OpenPIV, 15 pairs"] = 1e3 * seconds(openpiv) / count[0] * 15 / 3
    rows["ratio plain SciPy / ours"] = rows["plain SciPy, same search"] / rows["ours, same search"]
    for name, value in rows.items():
        print(f"{name:30s} {value:9.3f}" + ("" if "ratio" in name else " ms per point"), flush=True)
    return rows


def response(out: Path) -> dict:
    """Frequency response of the clutter filters (figure 3.3 of the thesis)."""
    frequency = np.linspace(0, 0.5, 501)
    figure, axis = plt.subplots(figsize=(6, 3.6), constrained_layout=True)
    for name, power in (
        ("FIR, 9 taps", FIRFilter().response(frequency)),
        ("polynomial, order 2", PolynomialFilter(2).response(frequency)),
        ("polynomial, order 3", PolynomialFilter(3).response(frequency)),
    ):
        axis.plot(frequency, 10 * np.log10(np.maximum(power, 1e-9)), label=name)
    axis.set(xlabel="frequency / PRF", ylabel="power response (dB)", ylim=(-80, 5))
    axis.grid(alpha=0.3)
    axis.legend()
    figure.savefig(out / "clutter_response.png", dpi=130)
    plt.close(figure)
    return {"fir_at_zero": float(FIRFilter().response(np.zeros(1))[0])}


PARTS = {part.__name__: part for part in (uniform, shear, snr, clutter, dropout, memory, speed, response)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; all without")
    parser.add_argument("--out", type=Path, default=Path("tracking"))
    arguments = parser.parse_args()
    unknown = set(arguments.parts) - set(PARTS)
    if unknown:
        parser.error(f"no part named {', '.join(sorted(unknown))}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    results = {}
    for name in arguments.parts or PARTS:
        print(f"-- {name}", flush=True)
        results[name] = PARTS[name](arguments.out)
    (arguments.out / "tracking.json").write_text(
        json.dumps({"threads": torch.get_num_threads(), **results}, indent=1)
    )


if __name__ == "__main__":
    main()
