"""What people read out of a flow, against a truth: raw, splines, ensemble, members, and the formulas alone.

    torchsph assimilate MEASURED.h5 --method spline,ensemble --keep-members --out RUN
    python examples/benchmarks/haemodynamics/quantities.py TRUTH.h5 MEASURED.h5 RUN [--tracers 20000] [--json FILE]

Curves: root mean square error over the root mean square of the true curve. The truth is these formulas on all frames of
the true velocities; for all that is of the pressure it is the CFD's own. "formula" is the formulas on the true
velocities at the measurement's frames: what they cost by themselves. "members" is the mean over the ensemble's members,
whose du/dt comes from their forecasts; "simulator" the projection's pressure. Coverage: share of frames that the
members' 90 % band holds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import torch

import geometry
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics import (
    UNITS,
    FlowDomain,
    FrameQuantities,
    MovingFlow,
    MovingWalls,
    beat_numbers,
    coverage,
    flow_components,
    seed_blood,
    time_derivative,
)
from torchsph.haemodynamics.flow_rate import peaks
from torchsph.methods.members.kept import read_members
from torchsph.methods.members.quantities import MemberQuantities

CURVES = ("kinetic_energy", "energy_loss", "vorticity_rms", "force_axial", "flow_inlet", "flow_outlet")
NUMBERS = ("stroke_volume", "filling_volume", "e_over_a", "energy_lost", "kinetic_energy_mean")


class Fields:
    """Curves, pressure and vorticity of one recording's frames, du/dt by differences of them."""

    def __init__(self, recording: geometry.Recording, *, own_sigma: bool = False) -> None:
        domain = FlowDomain.from_recording(recording)
        sampler = geometry.WallSampler(domain.motion, min(domain.grid.spacing))
        velocity = np.nan_to_num(filled_velocity(recording)).astype(np.float64)
        made = []
        for n in range(recording.frames):
            rate = time_derivative(velocity, domain.mask, domain.time, n, events=domain.events)
            sigma = recording.sigma[n] if own_sigma and recording.sigma is not None else None
            made.append(FrameQuantities(domain, n, sampler).of(velocity[n], rate, sigma=sigma))
        self.time = recording.time
        self.curves = {name: np.array([one.curves[name] for one in made]) for name in UNITS}
        self.pressure = np.stack([one.pressure for one in made])
        self.vorticity = np.stack([one.vorticity for one in made])


def off(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean square error over the root mean square."""
    return float(np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)))


def field_error(found: np.ndarray, true: np.ndarray, mask: np.ndarray, *, centred: bool = False) -> float:
    """The same over the mask's nodes of fields `(T, [D,] *shape)`; `centred`: each frame less its mean."""
    errors, sizes = 0.0, 0.0
    for one, right, inside in zip(found, true, mask, strict=True):
        a, b = one[..., inside].astype(np.float64), right[..., inside].astype(np.float64)
        if centred:
            a, b = a - a.mean(), b - b.mean()
        errors, sizes = errors + float(((a - b) ** 2).sum()), sizes + float((b**2).sum())
    return float(np.sqrt(errors / sizes))


def drops(domain: FlowDomain, pressure: np.ndarray) -> np.ndarray:
    """Base less apex `(T,)`, Pa, of pressures `(T, *shape)`."""
    return np.array([float(FrameQuantities(domain, n).pressure_difference(p)) for n, p in enumerate(pressure)])


def waves(times: np.ndarray, curve: np.ndarray, window: tuple[float, float]) -> list[float]:
    """Times, s, of the highest peak of a curve in each half of a window: E and A of the filling; nan for none."""
    middle, found = 0.5 * (window[0] + window[1]), []
    every = peaks(times, curve, least=0.02)
    for low, high in ((window[0], middle), (middle, window[1])):
        inside = [(height, at) for at, height in every if low <= at <= high]
        found.append(max(inside)[1] if inside else float("nan"))
    return found


def components(recording: geometry.Recording, velocity: np.ndarray, walls: MovingWalls, count: int) -> list[float]:
    """Shares of direct, retained, delayed and residual blood."""
    valves = recording.valve_intervals_or_derived()
    shut = {int(region): (opens, closes) for region, opens, closes in valves}
    (fills, filled), (ejects, ejected) = shut[1], shut[2]
    start = float(recording.time[0])
    flow = MovingFlow(
        recording.grid,
        recording.time,
        velocity,
        recording.mask,
        events=sorted((fills, filled, ejects, ejected)),
        dtype=torch.float32,
    )
    seeds = seed_blood(recording.grid, recording.mask[0], count, torch.Generator().manual_seed(0))
    span = (start, min(0.5 * (ejected + fills), float(recording.time[-1])))
    found = flow_components(flow, walls, seeds, ejection=span, filling=(span[1], float(recording.time[-1])))
    return [found.direct, found.retained, found.delayed, found.residual]


def members_of(run: Path, analysis: geometry.Recording) -> tuple[MemberQuantities, dict[str, np.ndarray], float]:
    """Quantities of all members, the fields of the pressure, and the seconds that the quantities took."""
    quantities, pressures, seconds = MemberQuantities(analysis), [], 0.0
    for frame in read_members(run / "members.h5", analysis):
        began = time.process_time()
        quantities.take(frame)
        seconds += time.process_time() - began
        of_frame = FrameQuantities(quantities.domain, frame.frame)
        estimate = of_frame.of(frame.field, frame.rate).pressure
        members = of_frame.of(frame.members, frame.member_rates).pressure
        simulated = (
            estimate if frame.pressure is None else np.where(np.isfinite(frame.pressure), frame.pressure, estimate)
        )
        pressures.append((estimate, members.mean(0), simulated))
    names = ("forecast rates", "members", "simulator")
    return (
        quantities,
        {name: np.stack(parts) for name, parts in zip(names, zip(*pressures, strict=True), strict=True)},
        seconds,
    )


def main() -> None:
    """Compute the table, print it, write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path)
    parser.add_argument("run", type=Path, help="with spline.h5, ensemble.h5 and members.h5")
    parser.add_argument("--tracers", type=int, default=20_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    every = geometry.read_recording(options.truth)
    measured, spline = geometry.read_recording(options.measured), geometry.read_recording(options.run / "spline.h5")
    ensemble = geometry.read_recording(options.run / "ensemble.h5")
    chosen = matching_frames(measured.time, every.time, "the truth")
    true = every.select(chosen)
    mask, domain = np.asarray(true.mask, bool), FlowDomain.from_recording(true)
    whole = Fields(every)
    right = {name: curve[chosen] for name, curve in whole.curves.items()}
    pressure = np.asarray(true.pressure, np.float64)
    right["pressure_difference"] = drops(domain, pressure)
    sources = {
        "formula": Fields(true),
        "raw": Fields(measured),
        "spline": Fields(spline),
        "ensemble": Fields(ensemble),
        "with variance": Fields(ensemble, own_sigma=True),
    }
    quantities, pressures, seconds = members_of(options.run, ensemble)
    found = quantities.found()
    bands = found.bands()
    curves = {name: one.curves for name, one in sources.items()}
    curves["members"] = {name: bands[name].mean for name in UNITS}
    result: dict[str, Any] = {"curves": {}, "fields": {}, "pressure difference": {}, "numbers": {}, "waves": {}}
    for name in CURVES:
        result["curves"][name] = {source: off(each[name], right[name]) for source, each in curves.items()}
    result["fields"]["vorticity"] = {
        source: field_error(one.vorticity, whole.vorticity[chosen], mask) for source, one in sources.items()
    }
    fields = {name: one.pressure for name, one in sources.items() if name != "with variance"} | pressures
    result["fields"]["pressure"] = {s: field_error(p, pressure, mask, centred=True) for s, p in fields.items()}
    fills = next((row[1], row[2]) for row in domain.intervals if int(row[0]) == domain.inlet)
    reference = waves(every.time, drops(FlowDomain.from_recording(every), every.pressure), fills)
    lines = {source: drops(domain, field) for source, field in fields.items()}
    for source, curve in lines.items():
        correlation = float(np.corrcoef(curve, right["pressure_difference"])[0, 1])
        result["pressure difference"][source] = {
            "error": off(curve, right["pressure_difference"]),
            "correlation": correlation,
        }
        apart = np.array(waves(true.time, curve, fills)) - reference
        result["waves"][source] = {"E [ms]": 1e3 * float(apart[0]), "A [ms]": 1e3 * float(apart[1])}
    exact = beat_numbers(every.time, whole.curves)
    from_walls = float(exact["stroke_volume_wall"])
    for source, each in curves.items():
        numbers = beat_numbers(true.time, each)
        result["numbers"][source] = {name: float(numbers[name] / exact[name] - 1) for name in NUMBERS}
        result["numbers"][source]["stroke volume over the walls'"] = float(numbers["stroke_volume"] / from_walls - 1)
    inside = {name: coverage(bands[name], right[name]) for name in UNITS if name != "volume"}
    result["coverage"] = inside
    walls = MovingWalls.from_recording(every)
    began = time.process_time()
    shares = {"truth, every frame": components(every, every.velocity, walls, options.tracers)}
    result["seconds of flow components"] = time.process_time() - began
    for source, one in (("formula", true), ("raw", measured), ("spline", spline), ("ensemble", ensemble)):
        shares[source] = components(true, np.nan_to_num(filled_velocity(one)), walls, options.tracers)
    result["flow components"] = shares
    result["seconds of members' quantities"] = seconds
    show(result)
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def show(result: dict[str, Any]) -> None:
    """Print everything, one row a line."""
    for table, rows in result.items():
        if not isinstance(rows, dict):
            print(f"{table}: {rows:.3g}")
            continue
        print(table)
        for name, row in rows.items():
            if isinstance(row, dict):
                row = "  ".join(f"{source} {value:.3f}" for source, value in row.items())
            elif isinstance(row, list):
                row = "  ".join(f"{value:.3f}" for value in row)
            print(f"  {name:24s}{row if isinstance(row, str) else format(row, '.3f')}")


if __name__ == "__main__":
    main()
