"""Error against seconds: vortices in the plane and in space, a channel and a ventricle, over resolution and options.

    python examples/benchmarks/speed_error.py [--quick] [--json FILE] [--picture FILE] [--flows NAME ...] [--threads N]
        [--recording FILE.h5]

A curve is one set of options, its points are resolutions; CPU seconds (which a shared machine falsifies least) and
wall seconds are those of the steps alone, for the ventricle of the whole forecast.

- plane: Taylor-Green at Re 100 after one decay time, relative L2 error of the velocity.
- space: Taylor-Green at Re 100, largest deviation of the kinetic energy at t = 1 ... 5 from a pseudo-spectral solution.
- channel: plane Poiseuille flow started from rest, RMS error over the largest velocity at t = 0.5.
- pipe: steady flow in a round pipe from its exact profile on, relative L2 error of the velocity after 0.2 s.
- ellipsoid: the core of an ejecting ellipsoid at three phases, relative L2 error against its potential flow.
- ventricle: error of forecasts over that of persistence, mean of 10, 20 and 40 ms ahead, on the sample recording that
  comes with torchsph or on another; the time is that of seeding, imposing and stepping, without walls' tables that
  can be kept.

--quick takes coarse resolutions and, in the plane and in space, a fifth of the time: under a minute.

Measured (results/speed_error.json and .png; the ventricle is a CFD phantom, one core of two in use by other work):

- ventricle: the projection and the weakly compressible preset make the same error (.315 .267 .236 and .326 .262 .242 of
  persistence's at 1.5, 1.2 and 1 mm) for .64, .57 and .49 of the time, starts counted. Steps to 1 ms cost .76 to .95 of
  those to 0.7 ms for 3 to 7 % more error, steps to 0.5 ms 1.01 to 1.12 for 1 to 4 % less. Sound speed 3.5 costs .70 to
  .78 of the preset's and is as good, 10 is worse for more; gamma from 1 to 7 makes no difference.
- ellipsoid: .084 .056 .044 by projection, .093 .071 .065 weakly compressible, in half of the time.
- plane: .0065 and .0056 at 40^2 and 60^2 with the projection's options for periodic flows in .34 and 1.2 s, against
  .0112 and .0057 in .70 and 1.4 s; at 20^2 .058 against .032. Its preset does not converge there: its relaxation stirs.
- space: .0129 and .0057 at 20^3 and 24^3 in .9 and 1.8 s, against .0157 and .0166 in 1.8 and 3.8 s.
- pipe: .0037 .0043 .0041 with the options for periodic flows against .0035 .0043 .0040 of the weakly compressible
  preset, in two to three times its time; channel: equal errors, three to four times slower: little sound to save.

The default preset is therefore the projection. PySPH's vortex: peers_vortex.py.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from walls import steady_pipe

import geometry
from examples.provenance import MODEL, write_table
from torchsph import GammaRamp, PotentialWall, Projection, Scene, Simulator, WeaklyCompressible, preset, skill
from torchsph.data import sample_truth
from torchsph.simulator.schemes.scheme import Scheme
from torchsph.validation import exact_flows as validation
from torchsph.validation.ellipsoid import PulsatingEllipsoid
from torchsph.validation.runs import channel, channel_error, kinetic_energy, taylor_green, taylor_green_error

SOURCES = ("examples/benchmarks/speed_error.py", "torchsph/methods/forecast_skill.py", *MODEL)

SAMPLE = sample_truth()
DECAY_TIME = 100 / (8 * math.pi**2)
# kinetic energy at t = 1 ... 5, Re 100: pseudo-spectral, 48^3 modes, Runge-Kutta 4 with steps of 0.02 (JAX-Fluids on
# 64^3 cells agrees within 0.1 %)
SPECTRAL_ENERGY = (0.1174809, 0.1090476, 0.0987915, 0.0868194, 0.0739643)
SMOOTHER = {"kernel": "wendland_c4", "smoothing_ratio": 2.4}
FINER = {"kernel": "quintic", "smoothing_ratio": 1.5}


@dataclass(frozen=True)
class Flow:
    """One flow: how a run is made, its resolutions, and what is varied.

    Attributes:
        measure: (resolution, scheme, backend, quick) -> error, CPU seconds, wall seconds, particle steps.
        base: the scheme that the curves change; presets stand beside it.
        sizes, quick: resolutions. curves: name -> changes of ``base``.
        unit: of the resolution.
    """

    measure: Callable[[float, Scheme, str, bool], tuple[float, float, float, float]]
    base: WeaklyCompressible
    sizes: tuple[float, ...]
    quick: tuple[float, ...]
    curves: dict[str, dict[str, object]]
    error: str
    unit: str = ""
    slow: tuple[str, ...] = field(default=("reference backend",))


def timed(action: Callable[[], float]) -> tuple[float, float, float]:
    """Error that ``action`` returns, and its CPU and wall seconds."""
    cpu, wall = time.process_time(), time.perf_counter()
    error = action()
    return error, time.process_time() - cpu, time.perf_counter() - wall


def plane(resolution: float, scheme: Scheme, backend: str, quick: bool) -> tuple[float, float, float, float]:
    """Taylor-Green in the plane."""
    run = taylor_green(int(resolution), scheme=scheme, backend=backend)

    def action() -> float:
        run.advance(DECAY_TIME / 5 if quick else DECAY_TIME)
        return taylor_green_error(run)

    return *timed(action), run.particles.count * int(run.record.steps)


def space(resolution: float, scheme: Scheme, backend: str, quick: bool) -> tuple[float, float, float, float]:
    """Taylor-Green in space."""
    run = taylor_green(int(resolution), dimension=3, scheme=scheme, backend=backend)

    def action() -> float:
        worst = 0.0
        for whole, energy in enumerate(SPECTRAL_ENERGY[: 1 if quick else 5], 1):
            run.advance(float(whole))
            worst = max(worst, abs(kinetic_energy(run) / energy - 1))
        return worst

    return *timed(action), run.particles.count * int(run.record.steps)


def poiseuille(resolution: float, scheme: Scheme, backend: str, _: bool) -> tuple[float, float, float, float]:
    """Start-up of plane Poiseuille flow."""
    run = channel("poiseuille", int(resolution), scheme=scheme, backend=backend)

    def action() -> float:
        run.advance(0.5)
        return channel_error(run)

    return *timed(action), run.particles.count * int(run.record.steps)


def pipe(resolution: float, scheme: Scheme, backend: str, quick: bool) -> tuple[float, float, float, float]:
    """Steady flow in a round pipe."""
    run, error = steady_pipe(scheme, int(resolution), 10, backend)

    def action() -> float:
        run.advance(0.05 if quick else 0.2)
        return error()

    return *timed(action), run.particles.count * int(run.record.steps)


def ellipsoid(resolution: float, scheme: Scheme, backend: str, quick: bool) -> tuple[float, float, float, float]:
    """Core of an ejecting ellipsoid."""
    body = PulsatingEllipsoid()
    run = body.start(scheme, int(resolution), backend)

    def action() -> float:
        wrong, flow = 0.0, 0.0
        for part in (0.1,) if quick else (0.1, 0.2, 0.3):
            run.advance(part * body.period)
            error, exact = body.core_errors(run)
            wrong, flow = wrong + error, flow + exact
        return math.sqrt(wrong / flow)

    return *timed(action), run.particles.count * int(run.record.steps)


def ventricle(
    resolution: float, scheme: Scheme, backend: str, quick: bool, file: Path = SAMPLE
) -> tuple[float, float, float, float]:
    """Forecasts of a recording; ``resolution`` is the spacing in mm."""
    recording = geometry.read_recording(str(file))
    model = Simulator(Scene.from_recording(recording, 1e-3 * resolution), scheme, backend=backend)
    every = recording.frames if quick else max(recording.frames // 8, 1)
    leads = (0.01,) if quick else (0.01, 0.02, 0.04)
    model.domain.prepare_until(float(recording.time[0]), float(recording.time[-1]))  # the walls' tables
    steps = 0.0

    def action() -> float:
        nonlocal steps
        result = skill(recording, model, leads, every=every)
        steps = model.start(float(recording.time[0])).particles.count * float(result.info["steps"])
        ratios = [row["nrmse"]["model"] / row["nrmse"]["persistence"] for row in result.leads]
        return sum(ratios) / len(ratios)

    return *timed(action), steps


# the incompressible scheme's longest step is one for the heart; here the flow's own speed limits it
PRESET_CURVES = {
    "weakly compressible preset": preset("weakly_compressible"),
    "projection": preset("projection", max_step=None, longest_step=None, courant=0.27),
}
REFERENCE = {"reference backend": {"backend": "reference"}}
FLOWS = {
    "plane": Flow(
        plane,
        WeaklyCompressible(**validation.PERIODIC_OPTIONS),
        (20, 40, 60),
        (16, 24),
        {
            "options for periodic flows": {},
            "sound speed 20": {"sound_speed": 20.0},
            "sound speed 7": {"sound_speed": 7.0},
            "quintic, h = 1.5": FINER,
            "Wendland C4, h = 2.4": SMOOTHER,
            "h = 1.6": {"smoothing_ratio": 1.6},
            "predictor-corrector": {"order": "predictor_corrector"},
            "symplectic Euler": {"order": "symplectic"},
            "projection, for periodic flows": Projection(**validation.PERIODIC_PROJECTION),
        }
        | REFERENCE,
        "relative L2 velocity error",
    ),
    "space": Flow(
        space,
        WeaklyCompressible(**validation.PERIODIC_OPTIONS_3D),
        (16, 20, 24),
        (16,),
        {
            "options for periodic flows": {},
            "sound speed 20": {"sound_speed": 20.0},
            "Wendland C4, h = 2.2": SMOOTHER | {"smoothing_ratio": 2.2},
            "h = 1.4": {"smoothing_ratio": 1.4},
            "shifting 8": {"shifting": 8.0},
            "projection, for periodic flows": Projection(**validation.PERIODIC_PROJECTION_3D),
        },
        "error of the kinetic energy",
    ),
    "channel": Flow(
        poiseuille,
        WeaklyCompressible(**validation.CHANNEL_OPTIONS),
        (10, 20, 40),
        (10, 20),
        {
            "options for channels": {},
            "sound speed 20": {"sound_speed": 20.0},
            "Wendland C4, h = 2.4": SMOOTHER,
            "h = 1.3": {"smoothing_ratio": 1.3},
            "position Verlet": {"order": "verlet"},
            "potential wall": {"wall": PotentialWall()},
        }
        | REFERENCE,
        "RMS error / largest velocity",
    ),
    "pipe": Flow(
        pipe,
        WeaklyCompressible(sound_speed=10.0, artificial_viscosity=None),
        (10, 16, 20),
        (10,),
        {"sound speed 10": {}, "projection, for periodic flows": Projection(**validation.PERIODIC_PROJECTION)},
        "relative L2 velocity error",
    ),
    "ellipsoid": Flow(
        ellipsoid,
        preset("weakly_compressible"),
        (12, 16, 20),
        (10,),
        {},
        "relative L2 error of the core",
    ),
    "ventricle": Flow(
        ventricle,
        preset("weakly_compressible"),
        (1.5, 1.2, 1.0),
        (2.5,),
        {
            "projection": preset("projection"),
            "projection, steps to 1 ms": preset("projection", max_step=1e-3, longest_step=None, courant=0.6),
            "projection, steps to 0.5 ms": preset("projection", max_step=5e-4, longest_step=None, courant=0.27),
            "sound speed 3.5": {"sound_speed": 3.5},
            "sound speed 10": {"sound_speed": 10.0},
            "gamma from 1 to 7 in 10 ms": {"gamma": 7.0, "gamma_ramp": GammaRamp()},
        },
        "error / error of persistence",
        " mm",
    ),
}


def measured(name: str, flow: Flow, quick: bool) -> list[dict]:
    """Rows of one flow, printed as they come."""
    sizes = flow.quick if quick else flow.sizes
    flow.measure(sizes[0], flow.base, "auto", True)  # loads the kernels outside the clock
    rows = []
    for curve, changes in {**PRESET_CURVES, **flow.curves}.items():
        backend, scheme = "auto", changes
        if isinstance(changes, dict):
            backend = changes.get("backend", "auto")
            scheme = replace(flow.base, **{k: v for k, v in changes.items() if k != "backend"})
        for size in sizes[:1] if curve in flow.slow and backend == "reference" else sizes:
            error, cpu, wall, steps = flow.measure(size, scheme, backend, quick)
            rows.append(
                {
                    "flow": name,
                    "curve": curve,
                    "resolution": size,
                    "error": error,
                    "cpu_s": cpu,
                    "wall_s": wall,
                    "step_per_s": steps / cpu,
                }
            )
            print(f"{name:<10} {curve:<28} {size:>5g} {error:>8.4f} {cpu:>7.2f} {steps / cpu / 1e6:>9.3f}", flush=True)
    return rows


def picture(rows: list[dict], file: Path) -> None:
    """Error over CPU seconds, a panel per flow and a line per curve."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    flows = list(dict.fromkeys(row["flow"] for row in rows))
    columns = min(2, len(flows))
    shape = (-(-len(flows) // columns), columns)
    figure, axes = pyplot.subplots(*shape, figsize=(6.2 * columns, 4.6 * shape[0]), squeeze=False, layout="constrained")
    for panel, name in zip(axes.flat, flows, strict=False):
        panel.set_prop_cycle(color=pyplot.cm.tab20.colors)
        for k, curve in enumerate(dict.fromkeys(row["curve"] for row in rows if row["flow"] == name)):
            mine = [row for row in rows if row["flow"] == name and row["curve"] == curve]
            style = "ks--" if k == 0 else "o-" if "projection" in curve else ".--"
            seconds, errors = [row["cpu_s"] for row in mine], [row["error"] for row in mine]
            panel.loglog(seconds, errors, style, linewidth=1.0 + ("projection" in curve), label=curve)
            for row in mine if k < 2 else []:
                text, place = f"{row['resolution']:g}{FLOWS[name].unit}", (row["cpu_s"], row["error"])
                panel.annotate(text, place, xytext=(4, 5), textcoords="offset points", fontsize=8)
        panel.set(xlabel="CPU seconds", ylabel=FLOWS[name].error, title=name)
        panel.grid(which="both", alpha=0.3)
        panel.xaxis.set_minor_formatter(pyplot.NullFormatter())
        panel.legend(fontsize=6, framealpha=0.5)
    for panel in axes.flat[len(flows) :]:
        panel.set_visible(False)
    figure.savefig(file, dpi=85)
    pyplot.close(figure)


def main() -> None:
    """Run the curves, print a table, write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="coarse and short: under a minute on two cores")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows here")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="write error against seconds here (PNG)")
    parser.add_argument("--flows", nargs="+", choices=FLOWS, default=list(FLOWS), help="default: all")
    parser.add_argument("--recording", type=Path, default=SAMPLE, help="of the ventricle (default: the sample)")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"{'flow':<10} {'curve':<28} {'n':>5} {'error':>8} {'CPU s':>7} {'M steps/s':>9}")
    rows: list[dict] = []
    flows = FLOWS | {"ventricle": replace(FLOWS["ventricle"], measure=partial(ventricle, file=options.recording))}
    for name in options.flows:
        rows += measured(name, flows[name], options.quick)
        load = os.getloadavg()[0]
        print(f"load of the machine: {load:.2f}")
        if options.json:  # after each flow: a full run takes minutes
            write_table(options.json, {"rows": rows, "load": load, "quick": options.quick}, SOURCES)
        if options.picture:
            picture(rows, options.picture)


if __name__ == "__main__":
    main()
