"""What people read out of a flow, against a truth: raw, splines, ensemble, members, and the formulas alone.

    torchsph assimilate MEASURED.h5 --method spline,ensemble [--keep-members] --out RUN
    torchsph assimilate MEASURED.h5 --method spline --quantities --out DRAWN
    python examples/benchmarks/haemodynamics/quantities.py TRUTH.h5 MEASURED.h5 RUN [--draws DRAWN] [--tracers 20000]
        [--json FILE]

Curves: root mean square error over the root mean square of the true curve. The truth is these formulas on all frames of
the true velocities; for all that is of the pressure it is the CFD's own. "formula" is the formulas on the true
velocities at the measurement's frames: what they cost by themselves. "members" is the mean over the ensemble's members,
whose du/dt comes from their forecasts; "simulator" the projection's pressure. Coverage: share of frames that the
members' 90 % band holds. Members are those of `members.h5` where they were kept, else what `quantities.json` says of
them, which leaves out their fields of pressure. "draws" are those from the splines' posterior, of a run of theirs.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import numpy as np
import torch

import geometry
from examples.provenance import ANALYSES, write_table
from torchsph.evaluation.frames import matching_frames
from torchsph.evaluation.metrics import filled_velocity
from torchsph.haemodynamics import (
    UNITS,
    FlowDomain,
    FrameQuantities,
    MovingFlow,
    MovingWalls,
    Summary,
    beat_numbers,
    coverage,
    flow_components,
    seed_blood,
    time_derivative,
)
from torchsph.haemodynamics.flow_rate import peaks
from torchsph.methods.members.kept import read_members
from torchsph.methods.members.quantities import MemberQuantities

SOURCES = ("examples/benchmarks/haemodynamics/quantities.py", "torchsph/haemodynamics", *ANALYSES)

Curves = dict[str, np.ndarray]

CURVES = ("kinetic_energy", "energy_loss", "vorticity_rms", "force_axial", "flow_inlet", "flow_outlet")
NUMBERS = ("stroke_volume", "filling_volume", "e_over_a", "energy_lost", "kinetic_energy_mean")


class Fields:
    """Curves, pressure and vorticity of one recording's frames, du/dt by differences of them."""

    def __init__(
        self, recording: geometry.Recording, frames: list[FrameQuantities], *, own_sigma: bool = False
    ) -> None:
        domain = frames[0].domain
        velocity = np.nan_to_num(filled_velocity(recording)).astype(np.float64)
        made = []
        for n in range(recording.frames):
            rate = time_derivative(velocity, domain.mask, domain.time, n, events=domain.events)
            sigma = recording.sigma[n] if own_sigma and recording.sigma is not None else None
            made.append(frames[n].of(velocity[n], rate, sigma=sigma))
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


def frames_of(recording: geometry.Recording) -> list[FrameQuantities]:
    """What depends on masks and walls alone, frame by frame."""
    domain = FlowDomain.from_recording(recording)
    sampler = geometry.WallSampler(domain.motion, min(domain.grid.spacing))
    return [FrameQuantities(domain, n, sampler) for n in range(recording.frames)]


def drops(frames: list[FrameQuantities], pressure: np.ndarray) -> np.ndarray:
    """Base less apex `(T,)`, Pa, of pressures `(T, *shape)`."""
    return np.array([float(frame.pressure_difference(p)) for frame, p in zip(frames, pressure, strict=True)])


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


class Members(NamedTuple):
    """Bands of the curves of all members, and fields of the pressure `(T, *shape)` by what they are made of."""

    bands: dict[str, Summary]
    pressures: dict[str, np.ndarray]


def kept_members(run: Path, analysis: geometry.Recording, frames: list[FrameQuantities]) -> Members:
    """Read out of the members themselves."""
    read, pressures = MemberQuantities(analysis), []
    for frame in read_members(run / "members.h5", analysis):
        read.take(frame)
        velocity = np.concatenate([frame.field[None], frame.members])
        made = frames[frame.frame].of(velocity, np.concatenate([frame.rate[None], frame.member_rates]))
        own = made.pressure[0]
        if frame.pressure is not None:
            own = np.where(np.isfinite(frame.pressure), frame.pressure, own)
        pressures.append((made.pressure[0], made.pressure[1:].mean(0), own))
    fields = zip(("forecast rates", "members", "simulator"), zip(*pressures, strict=True), strict=True)
    return Members(read.found().bands(), {name: np.stack(parts) for name, parts in fields})


def noted_bands(run: Path) -> dict[str, Summary]:
    """Bands of the curves of members, or of draws, as a run noted them."""
    noted = json.loads((run / "quantities.json").read_text(encoding="utf-8"))["members"]["curves"]
    return {
        name: Summary(*(np.array(curve[part], np.float64) for part in Summary._fields)) for name, curve in noted.items()
    }


def noted_members(run: Path, analysis: geometry.Recording, own: np.ndarray) -> Members:
    """What the run noted of them; where the simulator gives no pressure, the formula's `own` stands in."""
    bands = noted_bands(run)
    found = np.asarray(analysis.pressure, np.float64)
    return Members(bands, {"simulator": np.where(np.isfinite(found), found, own)})


class Comparison:
    """A truth, a measurement of it, and what a run made of that."""

    def __init__(self, truth: Path, measured: Path, run: Path, draws: Path | None = None) -> None:
        self.run, self.draws = run, draws
        self.every, self.measured = geometry.read_recording(truth), geometry.read_recording(measured)
        self.spline = geometry.read_recording(run / "spline.h5")
        self.ensemble = geometry.read_recording(run / "ensemble.h5")
        self.chosen = matching_frames(self.measured.time, self.every.time, "the truth")
        self.true = self.every.select(self.chosen)

    def read_out(self) -> dict[str, Any]:
        """Curves, fields, pressure differences, waves, numbers and coverage."""
        frames, all_frames = frames_of(self.true), frames_of(self.every)
        whole, mask = Fields(self.every, all_frames), np.asarray(self.true.mask, bool)
        right = {name: curve[self.chosen] for name, curve in whole.curves.items()}
        pressure = np.asarray(self.true.pressure, np.float64)
        right["pressure_difference"] = drops(frames, pressure)
        named = {"formula": self.true, "raw": self.measured, "spline": self.spline, "ensemble": self.ensemble}
        sources = {name: Fields(one, frames) for name, one in named.items()}
        fields = {name: one.pressure for name, one in sources.items()}
        curves = {name: one.curves for name, one in sources.items()}
        curves["with variance"] = Fields(self.ensemble, frames, own_sigma=True).curves
        if (self.run / "members.h5").is_file():
            bands, more = kept_members(self.run, self.ensemble, frames)
        else:
            bands, more = noted_members(self.run, self.ensemble, fields["ensemble"])
        fields |= more
        curves["members"] = {name: band.mean for name, band in bands.items()}
        drawn = {} if self.draws is None else noted_bands(self.draws)
        if drawn:
            curves["draws"] = {name: band.mean for name, band in drawn.items()}
        spins = {name: field_error(one.vorticity, whole.vorticity[self.chosen], mask) for name, one in sources.items()}
        return {
            "curves": {c: {name: off(each[c], right[c]) for name, each in curves.items()} for c in CURVES},
            "fields": {
                "vorticity": spins,
                "pressure": {name: field_error(one, pressure, mask, centred=True) for name, one in fields.items()},
            },
            **self._differences(frames, all_frames, fields, bands["pressure_difference"].mean),
            "numbers": self._numbers(whole.curves, curves),
            "coverage": {name: coverage(bands[name], right[name]) for name in UNITS if name != "volume"},
            **({"coverage of draws": {name: coverage(drawn[name], right[name]) for name in right}} if drawn else {}),
        }

    def _differences(
        self,
        frames: list[FrameQuantities],
        all_frames: list[FrameQuantities],
        fields: dict[str, np.ndarray],
        members: np.ndarray,
    ) -> dict[str, Any]:
        """Base less apex: error and correlation of the curve, and how far the peaks of E and A are off."""
        domain, differences, apart = frames[0].domain, {}, {}
        fills = next((row[1], row[2]) for row in domain.intervals if int(row[0]) == domain.inlet)
        reference = waves(self.every.time, drops(all_frames, np.asarray(self.every.pressure)), fills)
        right = drops(frames, np.asarray(self.true.pressure, np.float64))
        for name, curve in {
            **{name: drops(frames, field) for name, field in fields.items()},
            "members": members,
        }.items():
            correlation = float(np.corrcoef(curve, right)[0, 1])
            differences[name] = {"error": off(curve, right), "correlation": correlation}
            late = 1e3 * (np.array(waves(self.true.time, curve, fills)) - reference)
            apart[name] = {"E [ms]": float(late[0]), "A [ms]": float(late[1])}
        return {"pressure difference": differences, "waves": apart}

    def _numbers(self, exact_curves: Curves, curves: dict[str, Curves]) -> dict[str, Any]:
        """Numbers of the beat, relative to the truth's, and the stroke volume to the walls'."""
        exact, found = beat_numbers(self.every.time, exact_curves), {}
        for name, each in curves.items():
            numbers = beat_numbers(self.true.time, each)
            found[name] = {one: float(numbers[one] / exact[one] - 1) for one in NUMBERS}
            found[name]["over the walls'"] = float(numbers["stroke_volume"] / exact["stroke_volume_wall"] - 1)
        return found

    def components(self, count: int) -> dict[str, Any]:
        """Shares of the four flow components by `count` tracers, and the seconds that the truth's took."""
        walls, began = MovingWalls.from_recording(self.every), time.process_time()
        shares = {"truth, every frame": components(self.every, self.every.velocity, walls, count)}
        seconds = time.process_time() - began
        named = {"formula": self.true, "raw": self.measured, "spline": self.spline, "ensemble": self.ensemble}
        for name, one in named.items():
            shares[name] = components(self.true, np.nan_to_num(filled_velocity(one)), walls, count)
        return {"flow components": shares, "seconds of flow components": seconds}


def main() -> None:
    """Compute the table, print it, write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("truth", type=Path)
    parser.add_argument("measured", type=Path)
    parser.add_argument("run", type=Path, help="with spline.h5, ensemble.h5, and members.h5 or quantities.json")
    parser.add_argument("--draws", type=Path, metavar="DRAWN", help="a run of splines alone, with quantities.json")
    parser.add_argument("--tracers", type=int, default=20_000)
    parser.add_argument("--only", choices=("fields", "components"), help="one half, beside the other in the JSON file")
    parser.add_argument("--json", type=Path, help="results file, read and updated")
    options = parser.parse_args()
    torch.set_num_threads(1)
    given = Comparison(options.truth, options.measured, options.run, options.draws)
    there = options.json is not None and options.json.exists()
    result = json.loads(options.json.read_text(encoding="utf-8")) if there else {}
    result.pop("from", None)  # of the table that this one takes the place of
    if options.only != "components":
        result |= given.read_out()
    if options.only != "fields":
        result |= given.components(options.tracers)
    show(result)
    if options.json is not None:
        write_table(options.json, result, SOURCES)


def show(result: dict[str, Any]) -> None:
    """Print everything, one row a line."""
    for table, rows in result.items():
        if not isinstance(rows, dict):
            print(f"{table}: {rows if isinstance(rows, str) else format(rows, '.3g')}")
            continue
        print(table)
        for name, row in rows.items():
            if isinstance(row, dict):
                row = "  ".join(f"{source} {math.nan if v is None else v:.3f}" for source, v in row.items())
            elif isinstance(row, list):
                row = "  ".join(f"{value:.3f}" for value in row)
            print(f"  {name:24s}{row if isinstance(row, str) else format(row, '.3f')}")


if __name__ == "__main__":
    main()
