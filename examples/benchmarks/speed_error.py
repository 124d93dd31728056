"""Error against seconds: Taylor-Green in the plane at Re 100 over resolution, sound speed, kernel and backend.

    python examples/benchmarks/speed_error.py [--quick] [--json FILE] [--picture FILE] [--threads N]

Each row is one run from the analytic start to one decay time (--quick: a fifth of it): relative L2 error of the
velocity, CPU seconds (which a shared machine falsifies least) and wall seconds of the steps alone.
"""

import argparse
import json
import math
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from torchsph import Scene, Seeding, Simulator, preset, validation
from torchsph.scene import Fluid

VISCOSITY = 0.01
DECAY_TIME = 1 / (8 * math.pi**2 * VISCOSITY)

# what is varied -> the options that differ from validation.PERIODIC_OPTIONS, one curve over resolution each
CURVES = {
    "options for periodic flows": {},
    "default preset": None,
    "sound speed 20": {"sound_speed": 20.0},
    "sound speed 7": {"sound_speed": 7.0},
    "quintic spline, h = 1.5": {"kernel": "quintic", "smoothing_ratio": 1.5},
    "Wendland C4": {"kernel": "wendland_c4"},
    "h = 1.6": {"smoothing_ratio": 1.6},
    "predictor-corrector": {"order": "predictor_corrector"},
    "symplectic Euler": {"order": "symplectic"},
    "reference backend": {"backend": "reference"},
}


def one_run(resolution: int, duration: float, changes: dict | None) -> dict:
    """Error and seconds of one run; ``changes`` None takes the default preset as it is."""
    changes = dict(changes) if changes is not None else None
    backend = "auto" if changes is None else changes.pop("backend", "auto")
    options = {} if changes is None else validation.PERIODIC_OPTIONS | changes
    scheme = preset("weakly_compressible", **options)
    scene = Scene(spacing=1 / resolution, fluid=Fluid(1.0, VISCOSITY), period=(1.0, 1.0), dimension=2)
    run = Simulator(scene, scheme, backend=backend, seeding=Seeding(jitter=0.0)).start(0.0)
    points = run.particles.position * scene.spacing
    pressure = validation.taylor_green_2d_pressure(points, 0.0, VISCOSITY)
    run.particles = run.particles.changed(
        velocity=validation.taylor_green_2d(points, 0.0, VISCOSITY), deviation=pressure / scheme.sound_speed**2
    )
    cpu, wall = time.process_time(), time.perf_counter()
    run.advance(duration)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    points = run.particles.position.double() * scene.spacing
    exact = validation.taylor_green_2d(points, duration, VISCOSITY)
    error = float((run.particles.velocity.double() - exact).norm() / exact.norm())
    steps = int(run.record.steps)
    return {
        "resolution": resolution, "error": error, "cpu_s": cpu, "wall_s": wall, "steps": steps,
        "step_per_s": run.particles.count * steps / cpu,
    }  # fmt: skip


def picture(rows: list[dict], file: Path) -> None:
    """Error over CPU seconds, a line per curve."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8.5, 5))
    for k, curve in enumerate(dict.fromkeys(row["curve"] for row in rows)):
        mine = [row for row in rows if row["curve"] == curve]
        axes.loglog(
            [row["cpu_s"] for row in mine], [row["error"] for row in mine], "o-" if k < 2 else ".--",
            linewidth=2.5 if k < 2 else 1.0, label=curve,
        )  # fmt: skip
        for row in mine if k == 0 else []:
            axes.annotate(
                f"{row['resolution']}$^2$", (row["cpu_s"], row["error"]), xytext=(4, 6), textcoords="offset points"
            )
    axes.set(xlabel="CPU seconds", ylabel="relative L2 velocity error", title="Taylor-Green vortex, Re 100")
    axes.grid(which="both", alpha=0.3)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(file, dpi=110, bbox_inches="tight")
    pyplot.close(figure)


def main() -> None:
    """Run the curves, print a table, write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="coarse and short: under a minute on two cores")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="write error against seconds here (PNG)")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    duration = DECAY_TIME / 5 if options.quick else DECAY_TIME
    sizes = (20, 40) if options.quick else (25, 50, 100)
    one_run(sizes[0], duration / 50, {})  # loads the kernels outside the clock
    rows = []
    print(f"{'curve':<28} {'n':>4} {'error':>8} {'CPU s':>7} {'steps':>6} {'M steps/s':>9}")
    for curve, changes in CURVES.items():
        slow = changes is not None and changes.get("backend") == "reference"
        for size in sizes[:-1] if slow and not options.quick else sizes:
            row = {"curve": curve, **one_run(size, duration, changes)}
            rows.append(row)
            print(
                f"{curve:<28} {size:>4} {row['error']:>8.4f} {row['cpu_s']:>7.2f} {row['steps']:>6} "
                f"{row['step_per_s'] / 1e6:>9.3f}", flush=True,
            )  # fmt: skip
    load = os.getloadavg()[0]
    print(f"load of the machine: {load:.2f}")
    if options.json:
        options.json.write_text(json.dumps({"rows": rows, "load": load, "duration_s": duration}, indent=1) + "\n")
    if options.picture:
        picture(rows, options.picture)


if __name__ == "__main__":
    main()
