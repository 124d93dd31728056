"""Ensemble against spline on measurements of a known flow, while one thing at a time is made harder or easier.

    python examples/benchmarks/filter_sweeps.py TRUTH.h5 [--quick] [--stretch 0.18 0.38] [--only noise]
        [--json FILE] [--figure FILE] [--rows FILE]

Frame rate (25 to 200 Hz), noise (half to double), members, a weight that says nothing, and one Doppler component
alone. Measurements are made by ``torchsph.ultrasound.measure_noise``; all settings of both methods are automatic, the
same in every case, and neither sees the truth. ``--stretch`` takes a part of the recording (s), ``--quick`` 100 ms
around the fastest flow and fewer cases; ``--rows`` draws what an earlier run wrote.
Seconds of the clock mean nothing on a machine that is shared; those of the processor do.
Errors are RMS error / RMS speed of the truth over the mask; "smoothed" is the spline averaged over time (Gaussian of
10 ms), "free" the simulation without data.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch

import geometry
from examples.provenance import ANALYSES, write_table
from torchsph import assimilate, make_model
from torchsph.evaluation.metrics import evaluate, spread_over_skill
from torchsph.methods.free_run import run_freely
from torchsph.methods.measurement.prepared import PreparedMeasurement
from torchsph.ultrasound import NoiseModel, measure_noise

SOURCES = ("examples/benchmarks/filter_sweeps.py", "torchsph/ultrasound", *ANALYSES)

MEMBERS = 16
BLUR = 10e-3  # s, deviation of the average over time
QUICK = 0.05  # s on each side of the fastest flow
BASE = NoiseModel(every=2)
LINES = (("spline", "s--", "spline"), ("smoothed", "^:", "spline over time"), ("ensemble", "o-", "ensemble"))


@dataclass(frozen=True)
class Case:
    """One measurement and how many members meet it; ``change`` acts on the measurement."""

    sweep: str
    value: float | str
    noise: NoiseModel = BASE
    members: int = MEMBERS
    change: Callable[[geometry.Recording], geometry.Recording] | None = None


def without_say(measured: geometry.Recording) -> geometry.Recording:
    """The same weight wherever anything was measured."""
    return replace(measured, weight=np.where(np.asarray(measured.weight) > 0, 0.5, 0.0))


def along_z(measured: geometry.Recording) -> geometry.Recording:
    """What Doppler with a beam along z sees of it."""
    beam = np.zeros((3, *measured.grid.shape), np.float32)
    beam[2] = 1.0
    return replace(measured, velocity=measured.velocity * beam, beam=beam)


def cases(frame: float, quick: bool) -> Iterator[Case]:
    """All cases for a truth with a frame every ``frame`` s."""
    for rate in (50, 100) if quick else (25, 50, 100, 200):
        yield Case("frame rate, Hz", rate, replace(BASE, every=max(1, round(1 / rate / frame))))
    for factor in (0.5, 1.0, 2.0):
        yield Case("noise factor", factor, replace(BASE, lateral=factor * BASE.lateral, axial=factor * BASE.axial))
    for members in (8, 32) if quick else (8, 16, 32, 64):
        yield Case("members", members, members=members)
    yield Case("kind", "uninformative weight", change=without_say)
    yield Case("kind", "one Doppler component", change=along_z)


def averaged(smoothed: geometry.Recording) -> geometry.Recording:
    """The splines averaged over the frames in which a node lies in the mask."""
    kernel = np.exp(-0.5 * ((smoothed.time[:, None] - smoothed.time) / BLUR) ** 2)
    share = np.einsum("fg,g...->f...", kernel, smoothed.mask.astype(float))
    total = np.einsum("fg,gd...->fd...", kernel, smoothed.velocity * smoothed.mask[:, None])
    return smoothed.with_velocity((total / np.maximum(share, 1e-9)[:, None]).astype(np.float32))


def run(case: Case, truth: geometry.Recording, seed: int) -> dict:
    """One row: the errors of the methods and the seconds of the ensemble."""
    measured = measure_noise(truth, case.noise, seed)
    measured = measured if case.change is None else case.change(measured)
    prepared = PreparedMeasurement(measured)
    smoothed = prepared.smoothed
    step = min(measured.grid.spacing)
    fine, coarse = make_model(measured, spacing=step), make_model(measured, spacing=2 * step)
    began, worked = time.perf_counter(), time.process_time()
    ensemble = assimilate(prepared, fine, coarse=coarse, members=case.members, seed=seed)
    seconds, worked = time.perf_counter() - began, time.process_time() - worked
    found = {
        "spline": smoothed,
        "smoothed": averaged(smoothed),
        "free": run_freely(measured, coarse, smoothed.velocity[0]),
        "ensemble": ensemble.recording,
    }
    error = {name: evaluate(one, truth)["nrmse"].value for name, one in found.items()}
    return {
        "members": case.members,
        "nrmse": error,
        "to_spline": error["ensemble"] / error["spline"],
        "to_smoothed": error["ensemble"] / error["smoothed"],
        "spread_over_skill": spread_over_skill(ensemble.recording, truth).value,
        "seconds": seconds,
        "processor_seconds": worked,
        "frames": measured.frames,
        "real_time_factor": seconds / float(np.ptp(measured.time)),
        "gain": ensemble.info["gain"],
    }


def around_the_fastest(truth: geometry.Recording) -> geometry.Recording:
    """``QUICK`` s before and after the frame of the largest RMS speed, starting at an even frame."""
    power = [float(np.square(v[:, m]).mean()) for v, m in zip(truth.velocity, truth.mask, strict=True)]
    middle = truth.time[int(np.argmax(power))]
    return truth.select(np.abs(truth.time - middle) < QUICK + 1e-6)


def draw(rows: list[dict], path: Path) -> None:
    """Error against each number that was swept."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    sweeps = [name for name in dict.fromkeys(row["sweep"] for row in rows) if name != "kind"]
    figure, axes = plt.subplots(
        1, max(len(sweeps), 1), figsize=(4 * max(len(sweeps), 1), 3.6), layout="constrained", sharey=True, squeeze=False
    )
    for axis, sweep in zip(axes[0], sweeps, strict=False):
        some = sorted((row for row in rows if row["sweep"] == sweep), key=lambda row: row["value"])
        for name, style, label in LINES:
            axis.plot([row["value"] for row in some], [row["nrmse"][name] for row in some], style, label=label)
        axis.set(xlabel=sweep, xscale="log")
        axis.set_xticks([row["value"] for row in some], [f"{row['value']:g}" for row in some])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    highest = max(row["nrmse"][name] for row in rows for name, *_ in LINES)
    axes[0, 0].set_ylim(0, 1.05 * highest)  # the axes share it
    axes[0, 0].set_ylabel("RMS error / RMS true speed")
    axes[0, 0].legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("--quick", action="store_true", help="a short stretch and fewer cases")
    parser.add_argument("--stretch", type=float, nargs=2, metavar="S", help="part of the recording")
    parser.add_argument("--only", default="", help="part of a sweep's name")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--figure", type=Path, help="also draw the sweeps here")
    parser.add_argument("--rows", type=Path, help="draw what --json of an earlier run holds, and run nothing")
    options = parser.parse_args()
    if options.rows:
        draw(json.loads(options.rows.read_text())["rows"], options.figure)
        return
    torch.set_num_threads(options.threads)
    truth = geometry.read_recording(options.truth)
    truth = around_the_fastest(truth) if options.quick else truth
    if options.stretch is not None:
        first, last = options.stretch
        truth = truth.select((truth.time > first - 1e-6) & (truth.time < last + 1e-6))
    rows, done = [], {}
    for case in cases(float(np.median(np.diff(truth.time))), options.quick):
        if options.only not in case.sweep:
            continue
        key = replace(case, sweep="", value="")  # the case that all sweeps have in common runs once
        done[key] = done.get(key) or run(case, truth, options.seed)
        rows.append({"sweep": case.sweep, "value": case.value, **done[key]})
        errors = "  ".join(f"{name} {value:.3f}" for name, value in rows[-1]["nrmse"].items())
        print(
            f"{case.sweep:15s} {case.value!s:22s} {errors}  ratio {rows[-1]['to_spline']:.3f} "
            f"spread/skill {rows[-1]['spread_over_skill']:.2f}  {rows[-1]['seconds']:.0f} s",
            flush=True,
        )
        if options.json:  # after each case: a long sweep may be stopped
            about = {"seconds_of_flow": truth.time[[0, -1]].tolist(), "threads": options.threads, "seed": options.seed}
            write_table(options.json, about | {"rows": rows}, SOURCES)
    if options.figure:
        draw(rows, options.figure)


if __name__ == "__main__":
    main()
