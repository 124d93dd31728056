"""Random scenes, run one after the other: which finish, fail clearly, warn, or lose volume without a word.

Cavities in a plane and in space, closed or with valves, at speeds from .2 to 6 m/s, in every preset. A scene ends as

- finished: nothing to tell, and the particles' volume within 3 % of the cavity's,
- warned: it told of a volume (or something else) that is off,
- failed clearly: an exception of ours whose message says what and what to do,
- silent: 3 % of the volume lost or gained, or values that are not finite, without a word,
- obscure: any other exception.

    python examples/benchmarks/soak.py --scenes 300 --seconds 600 --out soak.jsonl

The same seed gives the same scenes; the time budget ends the list early, and the same command goes on with it: a scene
that stands in the file, one JSON line each, is not run again.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

import geometry
import torchsph as ts

LOST = 0.03
FRAMES = 9


@dataclass(frozen=True)
class Case:
    """A scene by its numbers.

    Attributes:
        preset: of the simulator.
        dimension: 2 or 3.
        valves: 0: closed; 1: one inlet; 2: inlet, then outlet.
        speed: m/s, of the flow through the valves, or of the wall where there is none.
        size: m, across.
        across: particles over it.
        duration: s.
        seed: of the particles.
    """

    preset: str
    dimension: int
    valves: int
    speed: float
    size: float
    across: int
    duration: float
    seed: int


def draw(generator: np.random.Generator) -> Case:
    """A random case."""
    dimension = int(generator.choice([2, 2, 3]))
    return Case(
        preset=str(generator.choice(list(ts.PRESETS))),
        dimension=dimension,
        valves=int(generator.integers(3)),
        speed=float(np.exp(generator.uniform(np.log(0.2), np.log(6.0)))),
        size=float(generator.uniform(0.015, 0.05)),
        across=int(generator.integers(8, 20 if dimension == 2 else 11)),
        duration=float(generator.uniform(0.01, 0.04)),
        seed=int(generator.integers(1000)),
    )


def scene_of(case: Case) -> ts.Scene:
    """An ellipsoid that breathes through its ends, or sways where it is closed."""
    half = np.full(case.dimension, 0.5 * case.size)
    half[-1] *= 1.4
    make = geometry.ellipse if case.dimension == 2 else geometry.ellipsoid
    body = make(tuple(half), case.size / case.across)
    height = body.centroids[:, -1] / half[-1]
    region = np.where(height > 0.8, 1, np.where(height < -0.8, 2, 0)).astype(np.uint8)
    body = geometry.Surface(body.vertices, body.faces, region if case.valves else 0 * region)
    times = np.linspace(0.0, case.duration, FRAMES)
    phase = np.pi * times / case.duration
    if case.valves == 0:
        shift = case.speed * case.duration / np.pi * (1 - np.cos(phase))
        places = [body.vertices + at * np.eye(case.dimension)[0] for at in shift]
    else:
        # the volume that comes in at this speed through the opening, evenly, then out again where there are two
        opening = float(np.linalg.norm(body.area_vectors[body.region == 1].sum(0)))
        gain = case.speed * opening * case.duration / body.volume / (1 if case.valves == 1 else 2)
        gain = min(gain, 0.8)
        share = times / case.duration if case.valves == 1 else 0.5 * (1 - np.cos(2 * phase))
        places = [body.vertices * (1 + gain * part) ** (1 / case.dimension) for part in share]
    motion = geometry.WallMotion.through(times, np.stack(places), body.faces, body.region)
    middle = case.duration if case.valves == 1 else 0.5 * case.duration
    valves = (ts.Valve(1, ((-1.0, middle),)), ts.Valve(2, ((middle, case.duration + 1.0),)))[: case.valves]
    return ts.Scene(case.size / case.across, walls=motion, valves=valves, dimension=case.dimension)


def outcome(case: Case) -> dict[str, object]:
    """What became of a case, and why."""
    began = time.perf_counter()
    told: list[str] = []
    ended, why, error, steps = "finished", "", 0.0, 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            run = ts.Simulator(scene_of(case), ts.preset(case.preset)).start(0.0, seed=case.seed)
            before = float(run.domain.filling(run.particles, 0.0))
            for part in range(1, 5):
                run.advance(case.duration * part / 4)
            steps = int(run.record.steps.sum())
            error = float(run.domain.filling(run.particles, run.time)) / before - 1.0
            if not bool(torch.isfinite(run.particles.velocity).all()):
                ended, why = "silent", "velocities are not finite"
        except (ts.NumericalFailure, ValueError) as fault:
            ended, why = "failed clearly", str(fault)
        except Exception as fault:
            ended, why = "obscure", f"{type(fault).__name__}: {fault}"
        told = sorted({str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)})
    if ended == "finished" and told:
        ended, why = "warned", told[0]
    if ended == "finished" and abs(error) > LOST and case.valves:
        ended, why = "silent", "volume off"
    return asdict(case) | {
        "ended": ended,
        "why": why,
        "volume_error": error,
        "steps": steps,
        "seconds": time.perf_counter() - began,
    }


def table(rows: list[dict[str, object]]) -> str:
    """Outcomes by preset and kind of scene."""
    names = ("finished", "warned", "failed clearly", "silent", "obscure")
    lines = [f"{'preset':22s}{'valves':>8s}" + "".join(f"{name:>16s}" for name in names) + f"{'worst':>10s}"]
    for preset in ts.PRESETS:
        for valves in (0, 1, 2):
            part = [row for row in rows if row["preset"] == preset and row["valves"] == valves]
            counts = Counter(str(row["ended"]) for row in part)
            worst = max((abs(float(str(row["volume_error"]))) for row in part), default=0.0) if valves else 0.0
            lines.append(
                f"{preset:22s}{valves:8d}" + "".join(f"{counts[name]:16d}" for name in names) + f"{worst:10.3f}"
            )
    return "\n".join(lines)


def finished_rows(path: Path | None) -> list[dict[str, object]]:
    """What an earlier call left; a line that was cut off is not there."""
    if path is None or not path.exists():
        return []
    whole = path.read_text(encoding="utf-8").rpartition("\n")[0]
    return [json.loads(line) for line in whole.splitlines()]


def main() -> None:
    """Run scenes until their number or the time is up."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--seconds", type=float, default=600.0, help="time budget")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="every scene with its outcome, JSON lines; goes on with those in it")
    args = parser.parse_args()
    generator, rows, began = np.random.default_rng(args.seed), finished_rows(args.out), time.perf_counter()
    if args.out:
        args.out.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    for number in range(args.scenes):
        case = draw(generator)
        if number < len(rows):
            if any(rows[number][name] != value for name, value in asdict(case).items()):
                raise SystemExit(f"{args.out}: line {number + 1} is another seed's scene; name another file")
            continue
        if time.perf_counter() - began > args.seconds:
            break
        row = outcome(case)
        rows.append(row)
        if row["ended"] != "finished":
            print({name: row[name] for name in row if name not in ("seconds",)}, flush=True)
        if args.out:
            with args.out.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(row) + "\n")
    print(f"{len(rows)} scenes in {sum(float(str(row['seconds'])) for row in rows):.0f} s")
    print(table(rows))


if __name__ == "__main__":
    main()
