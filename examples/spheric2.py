"""SPHERIC test 2: a dam breaks on an obstacle; pressure at two probes and a section, as one picture.

    python examples/spheric2.py [--spacing 0.04] [--until 1.5] [--measured FOLDER] [--picture spheric2.png]

FOLDER holds the digitised pressures of Kleefsman et al. 2005, `kleefsman_2005_P1.csv` and `..._P3.csv` (columns
t sqrt(g / H) and p / (rho g H), two lines of heading); without it the curves stand alone. About 25 CPU seconds at
0.04 m, 140 at 0.025 m.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot

from torchsph import Simulator, WeaklyCompressible
from torchsph.simulator.simulation import Simulation
from torchsph.validation.dam_breaks import (
    GRAVITY,
    IMPACT_OPTIONS,
    OBSTACLE,
    OBSTACLE_COLUMN,
    OBSTACLE_TANK,
    obstacle_pressures,
    obstacle_run,
    obstacle_scene,
)

SECTION_TIMES = (0.45, 0.8)  # s
DEPTH = OBSTACLE_COLUMN[1][2]


def section(axes: pyplot.Axes, run: Simulation) -> None:
    """Particles of the middle slice, coloured by p / (rho g H)."""
    spacing = run.units.length
    points = run.particles.position.double().numpy() * spacing
    sound = run.simulator.scheme.sound_speed
    pressure = run.particles.deviation.double().numpy() * sound**2 / (GRAVITY * DEPTH)
    middle = np.abs(points[:, 1]) < 1.5 * spacing
    shown = axes.scatter(
        points[middle, 0], points[middle, 2], c=pressure[middle], s=6, cmap="viridis", vmin=0.0, vmax=1.0
    )
    (left, _, _), (right, _, top) = OBSTACLE
    axes.fill([left, right, right, left], [0, 0, top, top], color="0.6")
    axes.set(xlim=(0, OBSTACLE_TANK[1][0]), ylim=(0, 0.8), aspect="equal", title=f"{run.time:.2f} s", ylabel="z / m")
    axes.figure.colorbar(shown, ax=axes, label="p / (rho g H)", fraction=0.02)


def main() -> None:
    """Run, say what it took, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spacing", type=float, default=0.04, help="of particles, m")
    parser.add_argument("--until", type=float, default=1.5, help="s")
    parser.add_argument("--measured", type=Path, metavar="FOLDER", help="with the digitised experiment")
    parser.add_argument("--picture", type=Path, default=Path("spheric2.png"), metavar="FILE")
    options = parser.parse_args()
    scene = obstacle_scene(options.spacing)
    scheme = WeaklyCompressible(**(IMPACT_OPTIONS | {"sound_speed": 10.0 * scene.reference_speed}))
    run = obstacle_run(Simulator(scene, scheme))
    figure, axes = pyplot.subplots(4, 1, figsize=(9, 11), layout="constrained")
    cpu, parts = time.process_time(), []
    for axis, stop in zip(axes, [t for t in SECTION_TIMES if t < options.until], strict=False):
        parts.append(obstacle_pressures(run, stop))
        section(axis, run)
    parts.append(obstacle_pressures(run, options.until))
    cpu = time.process_time() - cpu
    times, pressure = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    for k, probe in enumerate(("P1", "P3")):
        axis = axes[2 + k]
        axis.plot(times, pressure[:, k], color="C0", linewidth=0.5, alpha=0.5)
        axis.plot(times, np.convolve(pressure[:, k], np.full(4, 0.25), "same"), color="C0", label="mean over 20 ms")
        if options.measured:
            file = options.measured / f"kleefsman_2005_{probe}.csv"
            at, measured = np.loadtxt(file, delimiter=",", skiprows=2).T
            axis.plot(at * math.sqrt(DEPTH / GRAVITY), measured, "k.-", label="Kleefsman et al. 2005")
        axis.set(xlim=(0, options.until), ylim=(-0.1, 3), ylabel=f"{probe}: p / (rho g H)", xlabel="t / s")
        axis.legend()
    figure.savefig(options.picture, dpi=90)
    print(
        f"{run.particles.count} particles, {int(run.record.steps)} steps, {cpu:.0f} CPU seconds, "
        f"{int(run.record.outside.sum())} outside; picture: {options.picture}"
    )


if __name__ == "__main__":
    main()
