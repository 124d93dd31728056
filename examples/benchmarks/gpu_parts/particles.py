"""Pair sums and full steps of millions of particles."""

from __future__ import annotations

import time

import torch

from torchsph import Fluid, Scene, Simulator, WeaklyCompressible
from torchsph.pairs import MomentumTerms, PairState, RateTerms, Support, choose_backend
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.simulator.simulation import Simulation
from torchsph.validation.dam_breaks import GRAVITY, obstacle_run, obstacle_scene

from .bench import Bench

# smoothing lengths in spacings, and the neighbours that they give to Wendland's kernel of support 2 h
NEIGHBOURS = {1.2: "57 neighbours", 2.0: "up to 268 neighbours"}
FLOP_PER_PAIR = 57  # as `pairs.py` counts them
# the options of github.com/tomashalada/sph-benchmarks, damBreak3D
SOUND_SPEED = 45.17  # m/s
DAM_BREAK = WeaklyCompressible(
    kernel="wendland_c2",
    smoothing_ratio=2.0,
    sound_speed=SOUND_SPEED,
    gamma=7.0,
    pressure="sum",
    artificial_viscosity=0.02,
    laminar_viscosity=False,
    density_diffusion=0.1,
    shifting=None,
    bulk_damping=None,
    courant=0.15,
)
# spacing (m) -> what TNL-SPH and DualSPHysics 5.2 took for a step on an H100 SXM (results of 10 April 2025), ms
PEERS = {0.012: (2.308, 2.525), 0.008: (5.797, 6.669), 0.006: (12.509, 14.517)}


def box(side: int, device: str, dtype: torch.dtype = torch.float32) -> tuple[PairState, torch.Tensor]:
    """A periodic box of ``side``^3 particles with 20 % disorder, in an order of no use, and its periods."""
    generator = torch.Generator(device=device).manual_seed(side)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, device=device, dtype=dtype)

    axis = torch.arange(side, device=device, dtype=dtype)
    place = torch.cartesian_prod(axis, axis, axis)
    place = place[torch.randperm(len(place), generator=generator, device=device)]
    place = place + 0.4 * (random(len(place), 3) - 0.5)
    velocity = torch.sin(place.roll(1, 1) * (6.283185307179586 / side)) + 0.1 * random(len(place), 3)
    deviation = 0.002 * random(len(place))
    member = torch.zeros(len(place), dtype=torch.int64, device=device)
    state = PairState(place, velocity, torch.ones_like(deviation), deviation, 100.0 * deviation, member)
    return state, torch.full((3,), float(side), dtype=dtype, device=device)


def pairs(bench: Bench) -> None:
    """One right-hand side (continuity, pressure, artificial viscosity) in one loop, a Laplacian, and the search."""
    engine = choose_backend("auto", bench.device)
    sides = (14,) if bench.fast else (100, 160)
    for side in sides:
        for ratio, label in NEIGHBOURS.items():
            for dtype in (torch.float32,) if bench.fast else (torch.float32, torch.float64):
                if dtype == torch.float64 and side > 100:
                    continue
                what = {"particles": side**3, "neighbours": label, "precision": str(dtype).removeprefix("torch.")}
                with bench.attempt(**what):
                    _pairs(bench, engine, *box(side, bench.device, dtype), ratio, what)


def _pairs(bench: Bench, engine, state: PairState, period: torch.Tensor, ratio: float, what: dict) -> None:
    """Rows of one configuration."""
    support = Support(kernel("wendland_c2"), ratio, 3)
    rates, forces = RateTerms("volume"), MomentumTerms("sum", artificial=0.02)

    def search():
        return engine.search(state.position, state.member, support.radius, period=period)

    listed = search()
    few = slice(None, None, max(1, len(state.mass) // 2000))
    found = engine.interpolate(
        state.position,
        state.member,
        state.velocity[:, :1].contiguous(),
        support,
        state.position[few],
        state.member[few],
        period=period,
    )
    mean = float(found.count.double().mean()) - 1.0
    work = {
        "right-hand side": lambda: engine.right_hand_side(listed, state, support, rates, forces),
        "laplacian": lambda: engine.laplacian(listed, state, support, state.pressure),
        "search": search,
    }
    for name, call in work.items():
        taken = bench.seconds(call, repeats=3)
        rate = len(state.mass) / taken
        row = {"work": name, **what, "backend": engine.name, "seconds": taken, "m_particles_per_s": rate / 1e6}
        if name != "search":
            row |= {"mean_neighbours": mean, "g_pairs_per_s": rate * mean / 1e9}
        if name == "right-hand side":
            row["tflop_per_s"] = rate * mean * FLOP_PER_PAIR / 1e12
        bench.add(**row, memory_gb=bench.memory)


def steps(bench: Bench) -> None:
    """Full steps (search, two sums, equation of state, limits, accounts): a periodic box, and the dam break."""
    for side in (16,) if bench.fast else (100, 171):
        with bench.attempt(flow="periodic box", particles=side**3):
            spacing = 0.006
            scene = Scene(
                spacing=spacing,
                fluid=Fluid(1000.0, 0.001),
                period=(side * spacing,) * 3,
                reference_speed=SOUND_SPEED / 10,
            )
            run = Simulator(scene, DAM_BREAK, device=bench.device).start(0.0)
            place = run.particles.position * (6.283185307179586 / side)
            wave = torch.stack([place[:, 0].sin() * place[:, 1].cos(), -place[:, 0].cos() * place[:, 1].sin()], 1)
            run.particles = run.particles.changed(velocity=torch.cat([wave, 0 * wave[:, :1]], 1))
            _steps(bench, run, "periodic box, all fluid")
    for spacing in (0.1,) if bench.fast else PEERS:
        with bench.attempt(flow="dam break", spacing=spacing):
            began = time.perf_counter()
            run = obstacle_run(Simulator(obstacle_scene(spacing), DAM_BREAK, device=bench.device))
            run.domain.prepare_until(0.0, 1.0)
            tables = time.perf_counter() - began
            peers = dict(zip(("TNL-SPH (ms)", "DualSPHysics 5.2 (ms)"), PEERS.get(spacing, ()), strict=False))
            _steps(bench, run, "dam break", spacing=spacing, **peers, tables_s=tables)


def _steps(bench: Bench, run: Simulation, flow: str, **more: object) -> None:
    """Steps of the length that the limit of sound gives, some to get going, then some on the clock."""
    count = 2 if bench.fast else 20
    step = DAM_BREAK.courant * DAM_BREAK.smoothing_ratio * run.units.length / (1.1 * SOUND_SPEED)
    run.advance(run.time + 3 * step)
    before, began = int(run.record.steps), run.time
    searches = run.record.searches
    bench.wait()

    def some() -> None:
        run.advance(run.time + count * step)

    taken = bench._timed(some, 1)
    done = int(run.record.steps) - before
    fluid = run.particles.count
    bench.add(
        flow=flow,
        particles=fluid,
        backend=run.backend.name,
        **more,
        steps=done,
        searches=run.record.searches - searches,
        ms_per_step=1e3 * taken / done,
        m_particle_steps_per_s=fluid * done / taken / 1e6,
        simulated_ms=1e3 * (run.time - began),
        failed=bool(run.record.failed.any()),
        gravity=GRAVITY if "dam" in flow else 0.0,
        memory_gb=bench.memory,
    )
