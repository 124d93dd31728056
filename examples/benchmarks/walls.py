"""Wall models compared: accuracy against closed forms, their part of a step, and what the look-up fields cost.

    python examples/benchmarks/walls.py [--quick] [--json FILE] [--threads N]

Pipe: relative L2 error of the velocity of steady flow, 16 particles across, from the exact profile at the start (after
0.5 s, --quick 0.1 s). Containers: RMS pressure error over rho g H and the largest speed over sqrt(g H), 12 across, 2 s
(--quick 0.3 s, not settled) after gravity was switched on. Part of a step: CPU seconds of steps with walls less those
of the same steps without, in a sphere of 16,800 particles. Fields: CPU seconds for one moment of a ventricle's walls.
All options beside the wall are the scheme's own; potential walls start from their own random seeding.

Measured on one core of a shared machine whose load was 7 to 9:

    wall                      pipe  sphere p   speed   box p   speed  part of step
    complete kernel          1.28%     0.88%   0.44%   0.58%   0.60%         32.1%
    potential, no slip       7.99%    51.59%   3.64%  56.84%   7.74%         39.1%
    potential, free slip   148.57%    56.31%   6.65% 120.10%  31.22%         40.3%
    fields of one moment, 3358 faces, 299366 nodes: 0.115 s compiled, 0.540 s by the k-d tree

Ellipsoid: ejection of a pulsating ellipsoid with one open end (module ``validation_ellipsoid``); velocity of its core
against the potential flow, what the particles' volume is off, CPU seconds for 0.3 of a beat:

    ellipsoid, ejection         core  volume   CPU s
    default, 10 across        13.63%   0.63%     1.2
    default, 16 across         7.06%   0.21%     3.0
    default, 20 across         6.54%   0.14%     5.0
    projection, 10 across     13.12%   0.56%     1.1
    projection, 16 across      5.31%   0.23%     2.1
    projection, 20 across      4.79%   0.13%     3.1

The look-up is half of the walls' part; it waits for memory and takes less on a machine that is free.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import geometry
from torchsph import CompleteKernelWall, PotentialWall, Scene, Simulator, WeaklyCompressible
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.scene import Fluid
from torchsph.simulator.schemes.scheme import Scheme
from torchsph.simulator.simulation import Simulation
from torchsph.simulator.surroundings import PresentSurroundings
from torchsph.simulator.walls import closest as wall_closest
from torchsph.simulator.walls.fields import WallFields
from torchsph.validation import exact_wall_flows as validation_walls
from torchsph.validation.ellipsoid import PulsatingEllipsoid

WALLS = {
    "complete kernel": CompleteKernelWall(),
    "potential, no slip": PotentialWall(),
    "potential, free slip": PotentialWall(relaxation=None),
}
RADIUS, VISCOSITY = 0.5, 0.1
FORCE = 4 * VISCOSITY / RADIUS**2  # 1 m/s on the axis


def steady_pipe(
    scheme: Scheme, across: int, length: int, backend: str = "auto"
) -> tuple[Simulation, Callable[[], float]]:
    """Pipe flow that starts from its steady profile, and the relative L2 error of its velocity."""
    spacing = 1 / across
    tube = geometry.tube(RADIUS, (length + 14) * spacing, 0.5 * spacing)
    tube = tube.moved(tube.vertices - np.array([0, 0, 7 * spacing]))
    scene = Scene(
        spacing=spacing,
        fluid=Fluid(1.0, VISCOSITY),
        walls=geometry.WallMotion.at_rest(tube),
        period=(None, None, length * spacing),
        gravity=(0.0, 0.0, FORCE),
    )
    run = Simulator(scene, scheme, backend=backend).start(0.0)

    def exact() -> torch.Tensor:
        radius = run.particles.position[:, :2].double().norm(dim=1) * spacing
        return validation_walls.pipe_flow(radius, VISCOSITY, FORCE, RADIUS)

    def error() -> float:
        wrong = run.particles.velocity.double()
        wrong[:, 2] -= exact()
        return float(wrong.norm() / exact().norm())

    velocity = torch.zeros_like(run.particles.velocity)
    velocity[:, 2] = exact().float()
    run.particles = run.particles.changed(velocity=velocity)
    return run, error


def pipe(wall: object, duration: float, across: int = 16, length: int = 10) -> dict[str, float]:
    """Velocity error of steady pipe flow."""
    run, error = steady_pipe(WeaklyCompressible(sound_speed=10.0, artificial_viscosity=None, wall=wall), across, length)
    run.advance(duration)
    return {"velocity": error(), "outside": int(run.record.outside)}


def container(name: str, spacing: float) -> geometry.Surface:
    """A sphere of diameter 1 m, or a tilted box of side 1 m."""
    if name == "sphere":
        return geometry.ellipsoid((0.5, 0.5, 0.5), 0.5 * spacing)
    box = geometry.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), spacing)
    return box.moved(Rotation.from_euler("xyz", [25, 35, 10], degrees=True).apply(box.vertices))


def at_rest(name: str, wall: object, duration: float, across: int = 12) -> dict[str, float]:
    """Hydrostatic pressure error and spurious speed."""
    surface = container(name, 1 / across)
    height = float(np.ptp(surface.vertices[:, 2]))
    scene = Scene(
        spacing=1 / across,
        fluid=Fluid(1.0, 0.05),
        walls=geometry.WallMotion.at_rest(surface),
        gravity=(0.0, 0.0, -1.0),
    )
    scheme = WeaklyCompressible(sound_speed=10.0, wall=wall)
    run = Simulator(scene, scheme).start(0.0)
    run.advance(duration)
    p = run.particles
    error = p.deviation.double() * scheme.sound_speed**2 + p.position[:, 2].double() / across
    return {
        "pressure": float((error - error.mean()).square().mean().sqrt()) / height,
        "speed": float(p.velocity.norm(dim=1).amax()) / height**0.5,
        "outside": int(run.record.outside),
    }


def part_of_step(wall: object, across: int, steps: int) -> dict[str, float]:
    """CPU seconds per step and the walls' part of it: the same steps without them, from the same state."""
    surface = container("sphere", 1 / across)
    scene = Scene(spacing=1 / across, walls=geometry.WallMotion.at_rest(surface), gravity=(0.0, 0.0, -1.0))
    simulator = Simulator(scene, WeaklyCompressible(wall=wall))
    start = simulator.start(0.0).particles
    duration = steps * 0.35 * 1.3 / across / 6.0

    def seconds() -> float:
        run = simulator.resume(start, 0.0)
        began = time.process_time()
        run.advance(duration)
        return (time.process_time() - began) / int(run.record.steps)

    seconds()
    taken: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(5):
        taken[True].append(seconds())
        with mock.patch.object(PresentSurroundings, "sample", lambda surroundings, particles: None):
            taken[False].append(seconds())
    both, alone = (float(np.median(taken[key])) for key in (True, False))
    return {"particles": start.count, "step_s": both, "part": 1 - alone / both}


def fields(repeats: int) -> dict[str, float]:
    """CPU seconds of one moment of a moving ventricle's fields, with compiled closest points and without."""
    ventricle = geometry.Ventricle()
    times = np.linspace(0, 0.05, repeats + 1)
    surface = ventricle.surface(1e-3)
    walls = np.stack([surface.vertices * (1 + 0.1 * t / times[-1]) for t in times])
    motion = geometry.WallMotion.through(times, walls, surface.faces, surface.region)
    result: dict[str, float] = {"faces": len(surface.faces)}
    for name, closest in (("compiled", wall_closest.closest_on_grid), ("k-d tree", wall_closest.closest_by_tree)):
        made = WallFields(motion, 1e-3, 1.0, kernel("wendland_c2"), 1.3, True, "cpu", torch.float32)
        made.key(0, ())
        numbers = range(1, len(made.key_times.times))
        with mock.patch("torchsph.simulator.walls.fields.closest_on_grid", closest):
            began = time.process_time()
            for number in numbers:
                made.key(number, ())
            result[name] = (time.process_time() - began) / len(numbers)
        result["nodes"] = made.grid.size
    return result


def ellipsoid(name: str, across: int) -> dict[str, float]:
    """Error of the core of an ejecting ellipsoid, pooled over three phases, what its volume is off, and CPU seconds."""
    body = PulsatingEllipsoid()
    run = body.start(name, across)
    wrong, flow, missing, seconds = 0.0, 0.0, 0.0, 0.0
    for part in (0.1, 0.2, 0.3):
        began = time.process_time()
        run.advance(part * body.period)
        seconds += time.process_time() - began
        error, exact = body.core_errors(run)
        wrong, flow = wrong + error, flow + exact
        missing = max(missing, abs(body.missing(run)))
    return {"core": (wrong / flow) ** 0.5, "volume": missing, "seconds": seconds, "particles": run.particles.count}


def ellipsoids(resolutions: tuple[int, ...]) -> dict[str, dict[str, float]]:
    """The ellipsoid with both schemes, printed as it goes."""
    rows = {}
    print(f"{'ellipsoid, ejection':<24} {'core':>7} {'volume':>7} {'CPU s':>7}")
    for name in ("weakly_compressible", "projection"):
        for across in resolutions:
            rows[f"{name}, {across}"] = row = ellipsoid(name, across)
            label = f"{name}, {across} across"
            print(f"{label:<24} {row['core']:>7.2%} {row['volume']:>7.2%} {row['seconds']:>7.1f}", flush=True)
    return rows


def main() -> None:
    """Run everything, print tables, write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="short runs: under half a minute on one core")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    quick = options.quick
    out: dict[str, dict] = {}
    print(f"{'wall':<22} {'pipe':>7} {'sphere p':>9} {'speed':>7} {'box p':>7} {'speed':>7} {'part of step':>13}")
    for name, wall in WALLS.items():
        row = {
            "pipe": pipe(wall, 0.1 if quick else 0.5),
            **{shape: at_rest(shape, wall, 0.3 if quick else 2.0) for shape in ("sphere", "tilted box")},
            "step": part_of_step(wall, 16 if quick else 32, 20 if quick else 40),
        }
        out[name] = row
        print(
            f"{name:<22} {row['pipe']['velocity']:>7.2%} {row['sphere']['pressure']:>9.2%} "
            f"{row['sphere']['speed']:>7.2%} {row['tilted box']['pressure']:>7.2%} {row['tilted box']['speed']:>7.2%} "
            f"{row['step']['part']:>13.1%}",
            flush=True,
        )
    out["fields"] = fields(2 if quick else 5)
    made = out["fields"]
    print(
        f"fields of one moment, {made['faces']} faces, {made['nodes']} nodes: {made['compiled']:.3f} s compiled, "
        f"{made['k-d tree']:.3f} s by the k-d tree"
    )
    out["ellipsoid"] = ellipsoids((10,) if quick else (10, 16, 20))
    load = os.getloadavg()[0]
    print(f"load of the machine: {load:.2f}")
    if options.json:
        options.json.write_text(json.dumps({"rows": out, "load": load}, indent=1) + "\n")


if __name__ == "__main__":
    main()
