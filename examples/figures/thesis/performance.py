"""Steps per second over the number of particles and of neighbours, with and without XSPH (Grønli 2017, fig. 4.18)."""

from __future__ import annotations

import math
import time

from matplotlib.figure import Figure

import torchsph as ts

from ..material import Material
from ..record import Claim, Result
from ..style import axes

COUNTS = (1728, 4096, 10648, 27000, 64000)
RATIOS = {"thesis": (0.6, 0.84, 1.1), "default": (1.3,)}  # smoothing lengths in spacings; table 4.1 means 0.84
WARM, TIMED = 2, 6  # steps


def make(material: Material) -> Result:
    """Time steps of a periodic box of moving fluid, one thread."""
    counts = COUNTS[:2] if material.fast else COUNTS
    rows = []
    for preset, ratios in RATIOS.items():
        for ratio in ratios[::2] if material.fast else ratios:
            for xsph in (True, False) if preset == "thesis" else (False,):
                for count in counts:
                    rows.append(
                        {"preset": preset, "smoothing_ratio": ratio, "xsph": xsph} | _speed(preset, ratio, xsph, count)
                    )
    numbers = {"rows": rows}
    own = [row for row in rows if row["preset"] == "thesis" and row["particles"] == counts[-1]]
    few, many = (next(r for r in own if r["smoothing_ratio"] == k and r["xsph"]) for k in RATIOS["thesis"][::2])
    bare = next(r for r in own if r["smoothing_ratio"] == RATIOS["thesis"][0] and not r["xsph"])
    claims = [
        Claim(
            "larger cells, with more interactions per particle, cost iterations per second",
            many["steps_per_s"] < few["steps_per_s"],
            f"{few['neighbours']:.0f} neighbours {few['steps_per_s']:.1f} steps/s, {many['neighbours']:.0f} neighbours "
            f"{many['steps_per_s']:.1f} at {counts[-1]} particles",
        ),
        Claim(
            "the XSPH correction costs iterations per second",
            few["steps_per_s"] < 0.95 * bare["steps_per_s"],
            f"{few['steps_per_s']:.1f} steps/s with, {bare['steps_per_s']:.1f} without",
        ),
    ]
    return Result(numbers, claims, material.settings(recording=None, steps=TIMED), lambda: _draw(rows))


def _speed(preset: str, ratio: float, xsph: bool, count: int) -> dict[str, float]:
    """Steps and particle-steps per second of CPU, and neighbours per particle."""
    side = round(count ** (1 / 3))
    changes: dict[str, object] = {"smoothing_ratio": ratio}
    if preset == "thesis":
        changes |= {"steps_per_frame": None} | ({} if xsph else {"xsph": None})
    scheme = ts.preset(preset, **changes)
    model = ts.Simulator(ts.Scene(spacing=1.0 / side, fluid=ts.Fluid(1000.0, 1.0), period=(1.0,) * 3), scheme)
    run = model.start(0.0)
    wave = (2 * math.pi * run.particles.position * run.units.length)[:, [1, 2, 0]].sin()
    run.particles = run.particles.changed(velocity=wave / run.units.speed)
    step = _advance(run, WARM)
    began = time.process_time()
    taken = -int(run.record.steps)
    run.advance(run.time + TIMED * step)
    taken += int(run.record.steps)
    seconds = time.process_time() - began
    reach = run.domain.support_radius
    return {
        "particles": run.particles.count,
        "neighbours": 4 / 3 * math.pi * reach**3,
        "steps_per_s": taken / seconds,
        "particle_steps_per_s": taken * run.particles.count / seconds,
    }


def _advance(run: ts.Simulation, steps: int) -> float:
    """Take some steps, and say how long one is, s."""
    start = run.time
    guess = 1e-3
    while int(run.record.steps) < steps:
        run.advance(run.time + guess)
        guess *= 2
    return (run.time - start) / int(run.record.steps)


def _draw(rows: list[dict]) -> Figure:
    figure, (panel,) = (lambda pair: (pair[0], pair[1][0]))(axes(1, 1, 7, 4))
    kinds = dict.fromkeys((row["preset"], row["smoothing_ratio"], row["xsph"]) for row in rows)
    for preset, ratio, xsph in kinds:
        mine = [r for r in rows if (r["preset"], r["smoothing_ratio"], r["xsph"]) == (preset, ratio, xsph)]
        label = f"{preset}, {mine[0]['neighbours']:.0f} neighbours" + (", XSPH" if xsph else "")
        style = "s-" if preset == "default" else "o-" if xsph else "o--"
        panel.loglog([r["particles"] for r in mine], [r["steps_per_s"] for r in mine], style, label=label)
    panel.set(xlabel="particles", ylabel="steps per CPU second, one thread")
    panel.grid(which="both", alpha=0.3)
    panel.legend(fontsize=8)
    return figure
