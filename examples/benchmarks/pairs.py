"""Speed of the pair sums: right-hand sides per second by backend, precision, threads, size and batch.

    python examples/benchmarks/pairs.py --quick --json pairs.json

One right-hand side is the continuity rate, pressure (sum form), artificial viscosity and XSPH of a particle
in a periodic box with 20 % disorder, Wendland C2 with h = 1.2 spacings (60 neighbours). A step adds the
search with a margin of 0.2 spacings where it is due, the equation of state, a repelling wall and the
integration.

Competitors take turns, and each keeps its best time; with one thread the time is the processor's, so that
other programs disturb less, with more threads it is the wall clock's. ``peak_share`` counts the arithmetic on
pairs inside the support against the multiply-add rate measured in the same run, ``lane_share`` that on all
lanes. The last ratio is that of the simulator itself: a vortex in a periodic box with the default scheme, its step
(search, two passes, equation of state, shifting, limits, accounts) against its two passes alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import torch

from torchsph import Fluid, Scene, Simulator, WeaklyCompressible
from torchsph.native.library import library
from torchsph.pairs import Backend, MomentumTerms, PairState, RateTerms, Support, available_backends, choose_backend
from torchsph.pairs.smoothing_kernels import kernel
from torchsph.pairs.vectors import square_length

LENGTH = 1.2
SUPPORT = Support(kernel("wendland_c2"), LENGTH, 3)
RATES = RateTerms("volume", xsph=True)
FORCES = MomentumTerms("sum", artificial=0.5)
# additions, multiplications, extrema, roots, divisions of one pair with these terms, counted in passes.hpp
FLOP_PER_PAIR = 57
SOUND_SPEED, STEP, MARGIN = 10.0, 0.02, 0.2


@dataclass
class Row:
    """One measured configuration; rates are per second and for all threads together."""

    backend: str
    precision: str
    threads: int
    particles: int
    members: int
    neighbours: float
    rhs_per_s: float = 0.0
    step_per_s: float = 0.0
    search_per_s: float = 0.0
    rhs_per_cpu_s: float = 0.0
    peak_share: float | None = None
    lane_share: float | None = None
    bytes: int = 0


def box(side: int, members: int, dtype: torch.dtype) -> PairState:
    """Periodic boxes of ``side``^3 particles with a smooth and a random velocity, in lattice order."""
    generator = torch.Generator().manual_seed(side)
    lattice = torch.cartesian_prod(*[torch.arange(side, dtype=torch.float64)] * 3).repeat(members, 1)
    count = lattice.shape[0]
    position = lattice + 0.4 * (torch.rand((count, 3), generator=generator, dtype=torch.float64) - 0.5)
    noise = torch.randn((count, 3), generator=generator, dtype=torch.float64)
    velocity = torch.sin(position.roll(1, 1) * (6.283185307179586 / side)) + 0.1 * noise
    deviation = 0.002 * torch.randn(count, generator=generator, dtype=torch.float64)
    state = (
        position,
        velocity,
        torch.ones(count, dtype=torch.float64),
        deviation,
        SOUND_SPEED**2 * deviation,
    )
    member = torch.arange(members).repeat_interleave(side**3)
    return PairState(*(tensor.to(dtype) for tensor in state), member)


class Case:
    """A backend at work on boxes of particles."""

    def __init__(self, engine: Backend, side: int, members: int, dtype: torch.dtype, threads: int) -> None:
        self.engine, self.threads = engine, threads
        self.state = box(side, members, dtype)
        self.period = torch.full((3,), float(side), dtype=dtype)
        self.pairs = self.search()
        precision = {torch.float32: "float32", torch.float64: "float64"}[dtype]
        count = self.state.position.shape[0]
        self.row = Row(engine.name, precision, threads, count, members, self.neighbours())
        self.row.bytes = self.memory()
        self.moved, self.list_at = self.state, self.state.position

    def neighbours(self) -> float:
        """Mean number of other particles inside the support of a sample of particles."""
        state, every = self.state, max(1, self.state.position.shape[0] // 2000)
        query, member = state.position[::every], state.member[::every]
        moments = self.engine.interpolate(
            state.position,
            state.member,
            state.velocity[:, :1].contiguous(),
            SUPPORT,
            query,
            member,
            period=self.period,
        )
        return float(moments.count.double().mean()) - 1.0

    def memory(self) -> int:
        """Bytes of the neighbour list and of the packed rows and blocks that a pass reads."""
        if self.engine.name == "reference":
            return 2 * 8 * self.pairs.first.numel()
        slots = self.pairs.lists[0].numel()
        return self.pairs.bytes + slots * (16 + 11) * self.state.position.element_size()

    def lanes(self) -> float:
        """Lanes that the lists make a pass work on, per particle (their few header words counted in)."""
        return 8.0 * self.pairs.used / self.row.particles

    def search(self):
        """A new neighbour list."""
        return self.engine.search(self.state.position, self.state.member, SUPPORT.radius, period=self.period)

    def right_hand_side(self):
        """Rates and accelerations at the present state."""
        return self.engine.right_hand_side(self.pairs, self.state, SUPPORT, RATES, FORCES)

    def step(self) -> None:
        """Search where due, right-hand side, equation of state, wall at z = 0, symplectic Euler."""
        old = self.moved
        moved = square_length(old.position - self.list_at).amax()
        if not hasattr(self, "list_pairs") or float(moved) >= (0.5 * MARGIN) ** 2:
            self.list_at = old.position
            self.list_pairs = self.engine.search(
                old.position, old.member, SUPPORT.radius, margin=MARGIN, period=self.period
            )
        rates, acceleration = self.engine.right_hand_side(self.list_pairs, old, SUPPORT, RATES, FORCES)
        deviation = old.deviation - STEP * (1.0 + old.deviation) * rates.divergence
        acceleration[:, 2] += SOUND_SPEED * (0.5 - old.position[:, 2]).clamp(0.0, 1.0)
        velocity = old.velocity + STEP * acceleration
        position = old.position + STEP * (velocity + 0.2 * rates.xsph)
        pressure = SOUND_SPEED**2 / 7.0 * ((1.0 + deviation) ** 7 - 1.0)
        self.moved = PairState(position, velocity, old.mass, deviation, pressure, old.member)

    def clock(self, work: Callable[[], object]) -> tuple[float, float]:
        """Seconds that ``work`` takes on this case's threads (see above), and seconds of processor time."""
        torch.set_num_threads(self.threads)
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return (cpu if self.threads == 1 else wall), cpu


def in_turns(cases: list[Case], rounds: int, steps: int) -> None:
    """Measure all cases round by round and keep each one's best."""
    for _ in range(rounds):
        for case in cases:
            row, count = case.row, case.row.particles
            seconds, cpu = case.clock(case.right_hand_side)
            row.rhs_per_s = max(row.rhs_per_s, count / seconds)
            row.rhs_per_cpu_s = max(row.rhs_per_cpu_s, count / cpu)
            row.search_per_s = max(row.search_per_s, count / case.clock(case.search)[0])
            if steps:
                seconds, _ = case.clock(lambda case=case: [case.step() for _ in range(steps)])
                row.step_per_s = max(row.step_per_s, steps * count / seconds)


def simulator_share(engine: Backend, side: int, rounds: int) -> float:
    """Processor time of the default scheme's two passes over that of the simulator's whole step, one thread."""
    torch.set_num_threads(1)
    scene = Scene(spacing=1 / side, fluid=Fluid(1.0, 0.01), period=(1.0,) * 3)
    scheme = WeaklyCompressible(sound_speed=SOUND_SPEED)
    run = Simulator(scene, scheme, backend=engine.name).start(0.0)
    angle = run.particles.position * (6.283185307179586 / side)
    wave = torch.stack([angle[:, 0].sin() * angle[:, 1].cos(), -angle[:, 0].cos() * angle[:, 1].sin()], 1)
    run.particles = run.particles.changed(velocity=torch.cat([wave, 0 * wave[:, :1]], 1))
    support = Support(kernel(scheme.kernel), scheme.smoothing_ratio, 3)
    rates = RateTerms(scheme.continuity, diffusion=True, concentration=True)
    forces = MomentumTerms(scheme.pressure, artificial=0.2, laminar=0.01 * side)
    period = torch.full((3,), float(side))
    whole, sums = float("inf"), float("inf")
    for _ in range(rounds):
        steps, begin = int(run.record.steps), time.process_time()
        run.advance(run.time + 20 * scheme.courant * scheme.smoothing_ratio / side / SOUND_SPEED)
        whole = min(whole, (time.process_time() - begin) / (int(run.record.steps) - steps))
        p = run.particles
        pairs = engine.search(p.position, p.member, support.radius, margin=0.25, period=period)
        begin = time.process_time()
        engine.rates(pairs, p.state(p.deviation), support, rates)
        engine.momentum(pairs, p.state(p.deviation), support, forces)
        sums = min(sums, time.process_time() - begin)
    return sums / whole


def fma_peak() -> float:
    """Float32 multiply-add rate of one core in the loaded library, flop per processor second."""
    work, best = library().handle.sph_fma, 0.0
    for _ in range(9):
        begin = time.process_time()
        flop = work(1, 4_000_000, 0.999)
        best = max(best, flop / (time.process_time() - begin))
    return best


def engines() -> dict[str, Backend]:
    """The backends present, by name; the missing ones are named on stderr."""
    found = {}
    for status in available_backends():
        if status.present:
            found[status.name] = choose_backend(status.name)
        else:
            print(f"backend '{status.name}' is not measured: {status.reason}", file=sys.stderr)
    return found


def measure(quick: bool) -> dict[str, object]:
    """All rows, the ratios that the project promises, and the machine's load."""
    load = [os.getloadavg()]
    found, single, double = engines(), torch.float32, torch.float64
    compiled = "cpu" in found
    rounds = 5 if quick else 9
    small = [Case(found["reference"], 30, 1, single, 1)]
    if compiled:
        cpu = found["cpu"]
        small += [Case(cpu, 30, 1, single, 1), Case(cpu, 30, 1, single, 2), Case(cpu, 30, 1, double, 1)]
        small += [Case(cpu, 22, 1, single, 1)]
    in_turns(small, rounds=2 if quick else 3, steps=0)
    in_turns(small[1:], rounds, steps=10)
    cases = list(small)
    if compiled:
        batch = [Case(cpu, 22, 16, single, 1), Case(cpu, 55, 1, single, 1), Case(cpu, 55, 1, single, 2)]
        in_turns(batch, rounds, steps=3)
        cases += batch
        for side in () if quick else (100,):
            large = [Case(cpu, side, 1, single, threads) for threads in (1, 2)]
            in_turns(large, 5, steps=2)
            cases += large
        peak = fma_peak()
        for case in cases:
            row = case.row
            if row.backend == "cpu" and row.precision == "float32":
                row.peak_share = row.rhs_per_s * row.neighbours * FLOP_PER_PAIR / (peak * row.threads)
                row.lane_share = row.rhs_per_s * case.lanes() * FLOP_PER_PAIR / (peak * row.threads)
    load.append(os.getloadavg())
    report: dict[str, object] = {"rows": [asdict(case.row) for case in cases], "load": load}
    if compiled:
        report |= {
            "instruction_set": library().instruction_set,
            "fma_peak_per_core": peak,
            "ratios": ratios(small, batch)
            | {"simulator's step over its pair sums, 27k": simulator_share(cpu, 30, rounds)},
        }
    return report


def ratios(small: list[Case], batch: list[Case]) -> dict[str, float]:
    """The promised ratios, each from cases that took turns."""
    reference, one, two = (case.row for case in small[:3])
    members, whole, whole_two = (case.row for case in batch)
    return {
        "cpu over reference, 27k, one thread": one.rhs_per_s / reference.rhs_per_s,
        "step over right-hand side, 27k": one.step_per_s / one.rhs_per_s,
        "step over right-hand side, 166k": whole.step_per_s / whole.rhs_per_s,
        "two threads over one, 27k": two.rhs_per_s / one.rhs_per_s,
        "two threads over one, 166k": whole_two.rhs_per_s / whole.rhs_per_s,
        "processor time of two threads over one, 166k": whole.rhs_per_cpu_s / whole_two.rhs_per_cpu_s,
        "cost per particle, 16 x 10.6k over 1 x 166k": whole.rhs_per_s / members.rhs_per_s,
    }


def table(report: dict[str, object]) -> str:
    """The rows as text."""
    lines = [
        "backend    precision threads particles members neighbours  M rhs/s  M step/s  M search/s"
        "  % peak  % lanes      MB"
    ]
    for row in report["rows"]:
        shares = ["" if s is None else f"{100 * s:.0f}" for s in (row["peak_share"], row["lane_share"])]
        lines.append(
            f"{row['backend']:10s} {row['precision']:9s} {row['threads']:7d} {row['particles']:9d} "
            f"{row['members']:7d} "
            f"{row['neighbours']:10.1f} {row['rhs_per_s'] / 1e6:8.3f} {row['step_per_s'] / 1e6:9.3f} "
            f"{row['search_per_s'] / 1e6:11.3f} {shares[0]:>7s} {shares[1]:>8s} {row['bytes'] / 2**20:7.1f}"
        )
    lines += [f"{name}: {value:.2f}" for name, value in report.get("ratios", {}).items()]
    if "ratios" in report:
        peak = report["fma_peak_per_core"] / 1e9
        lines.append(f"multiply-add peak of a core ({report['instruction_set']}): {peak:.0f} Gflop/s")
    before, after = report["load"]
    lines.append(
        f"load of the machine (1 min): {before[0]:.1f} before, {after[0]:.1f} after; {os.cpu_count()} processors"
    )
    return "\n".join(lines)


def main() -> int:
    """Measure, print, and write the JSON file where one is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="under a minute; no case above 200,000 particles")
    parser.add_argument("--json", metavar="FILE", help="write the rows there")
    options = parser.parse_args()
    if "OMP_WAIT_POLICY" not in os.environ:  # OpenMP reads it when torch is loaded: start again with it
        # threads that wait shall sleep: where other programs run, those that spin keep the working ones waiting
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | {"OMP_WAIT_POLICY": "passive"})
    report = measure(options.quick)
    print(table(report))
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(report, file, indent=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
