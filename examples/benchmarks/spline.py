"""How fast and how exact the spline solvers are, against SciPy on the same rows.

    python examples/benchmarks/spline.py [--quick] [--json FILE] [--png FILE] [--threads N]

Two tables: time, true relative gradient and memory of each solver at a fixed grid, and the error of a
noise-free fit over grids of rising fineness. Every row runs in a process of its own, so that its memory
(peak above the imports) is its own, and is written as soon as it is there. On a shared machine look at the CPU
seconds; threads that wait for others sleep (OMP_WAIT_POLICY), so that these count work alone. The errors of smoothers
on measurements are in spline_phantom.py.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import scipy.sparse as sp
import scipy.sparse.linalg as sla
import torch

import regularize as rg
from examples.provenance import write_table

SOURCES = (
    "examples/benchmarks/spline.py",
    "regularize",
)

AXES = torch.tensor([40e-3, 20e-3, 20e-3], dtype=torch.float64)  # semi-axes of the ventricle-like ellipsoid, m
TOLERANCE = 1e-6
SCIPY_SAMPLE = 40  # iterations timed where a full SciPy run would take many minutes


def flow(points: torch.Tensor, waves: float = 1.0) -> torch.Tensor:
    """A smooth divergence-free field (each component depends on the other coordinates only), m/s."""
    x, y, z = (3 * waves * points / AXES).unbind(1)
    return torch.stack([torch.sin(y) + torch.cos(z), torch.sin(z) - torch.cos(x), torch.cos(x + y)], dim=1)


def inside(count: int, generator: torch.Generator) -> torch.Tensor:
    """Points uniform in the ellipsoid."""
    direction = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    direction /= direction.norm(dim=1, keepdim=True)
    return direction * torch.rand(count, 1, generator=generator, dtype=torch.float64) ** (1 / 3) * AXES


def system(samples: int, nodes: tuple[int, ...], seed: int = 0) -> rg.System:
    """Rows as in thesis eq. 3.22: samples, divergence at as many points, 2,000 wall points, damping."""
    generator = torch.Generator().manual_seed(seed)
    knots = rg.Knots(
        tuple((-1.05 * AXES).tolist()),
        tuple(2.1 * float(a) / (n - 3) for a, n in zip(AXES, nodes, strict=True)),
        tuple(n - 3 for n in nodes),
    )
    points = inside(samples, generator)
    weight = torch.rand(samples, 1, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64) * 0.9 + 0.1
    noise = 0.1 * torch.randn(samples, 3, generator=generator, dtype=torch.float64)
    wall = torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    wall = wall / wall.norm(dim=1, keepdim=True)
    normals = (wall / AXES) / (wall / AXES).norm(dim=1, keepdim=True)
    on_wall = wall * AXES
    strength = torch.full((samples,), 500**0.5 * 2.1 * float(AXES[0]) / 29, dtype=torch.float64)
    blocks = [
        rg.VectorRows(knots, points, flow(points) + noise, weight),
        rg.DivergenceRows(knots, inside(samples, generator), 3, strength),
        rg.DirectionRows(knots, on_wall, normals, (normals * flow(on_wall)).sum(1), torch.full((2000,), 200**0.5)),
    ]
    return rg.System(knots, 3, blocks, 0.5**0.5)


def relative_gradient(rows: rg.System, x: torch.Tensor) -> float:
    return float(rows.gradient(x).norm() / rows.right_side().norm())


def run_direct(rows: rg.System, engine: str | None, single: bool = False) -> dict:
    start = clock()
    prepared = rg.PreparedSystem(rows, engine=engine)
    # without the factor: the check of the gradient below is no part of the solver's memory
    solution = rg.solve_direct(prepared, tolerance=TOLERANCE, single=single)[0]
    return took(start) | {"gradient": relative_gradient(rows, solution.x), "iterations": solution.iterations}


def run_next_frame(rows: rg.System) -> dict:
    """The same positions and weights, new velocities: only right-hand side and triangular solves."""
    prepared = rg.PreparedSystem(rows)
    factor = prepared.factor()
    new = [rows.blocks[0].with_target(-rows.blocks[0].target.view(-1, 3)), *rows.blocks[1:]]
    other = rg.System(rows.knots, 3, new, rows.damping)
    rg.solve_direct(prepared.with_targets(other), factor=factor)  # once to warm up
    start = clock()
    solution, _ = rg.solve_direct(prepared.with_targets(other), factor=factor, tolerance=TOLERANCE)
    return took(start) | {"gradient": relative_gradient(other, solution.x), "iterations": solution.iterations}


def run_new_weights(rows: rg.System, samples: int, nodes: tuple[int, ...]) -> dict:
    """The same positions, new weights: conjugate gradients with the first frame's factor."""
    prepared = rg.PreparedSystem(rows)
    first, factor = rg.solve_direct(prepared)
    generator = torch.Generator().manual_seed(9)
    change = torch.rand(samples, 1, generator=generator, dtype=torch.float64) + 0.5
    other = rg.System(rows.knots, 3, [rows.blocks[0].with_weight(change), *rows.blocks[1:]], rows.damping)
    start = clock()
    initial = first.x.view(-1, 3)
    solution = rg.pcg(prepared.with_weights(other), factor, start=initial, tolerance=TOLERANCE)
    return took(start) | {"gradient": relative_gradient(other, solution.x), "iterations": solution.iterations}


def run_krylov(rows: rg.System, method: str, sparse: bool) -> dict:
    start = clock()
    apply = rg.sparse_operators(rows) if sparse else (rows.matvec, rows.rmatvec)
    solver = {"lsqr": rg.lsqr, "lsmr": rg.lsmr}[method]
    solution = solver(*apply, rows.target(), damping=rows.damping, tolerance=TOLERANCE)
    return took(start) | {"gradient": relative_gradient(rows, solution.x), "iterations": solution.iterations}


def run_scipy(rows: rg.System, method: str, full: bool) -> dict:
    """SciPy on CSR, with the building of the matrix.

    Its atol says little about the true gradient: it is tightened until that is reached, and the last run
    alone counts.
    """
    start = clock()
    matrix, b = rg.sparse_matrix(rows), rows.target().numpy()
    parts = (matrix.values().numpy(), matrix.col_indices().numpy(), matrix.crow_indices().numpy())
    matrix = sp.csr_matrix(parts, shape=tuple(matrix.shape))
    setup = took(start)
    solver, limit = (sla.lsqr, "iter_lim") if method == "lsqr" else (sla.lsmr, "maxiter")
    if not full:
        start = clock()
        solver(matrix, b, damp=rows.damping, atol=0, btol=0, **{limit: SCIPY_SAMPLE})
        return took(start) | {"gradient": None, "iterations": SCIPY_SAMPLE}
    for tolerance in (1e-7, 3e-8, 1e-8, 3e-9, 1e-9, 1e-10, 1e-11):
        start = clock()
        found = solver(matrix, b, damp=rows.damping, atol=tolerance, btol=tolerance, **{limit: 20000})
        row = {name: value + setup[name] for name, value in took(start).items()}
        row["iterations"] = int(found[2])
        row["gradient"] = relative_gradient(rows, torch.from_numpy(found[0]))
        if row["gradient"] <= TOLERANCE:
            return row
    raise RuntimeError(f"SciPy {method} stayed at a true relative gradient of {row['gradient']:.1e}")


def run_accuracy(samples: int, nodes: tuple[int, ...]) -> dict:
    """Relative error of a fit to noise-free samples, at other points.

    Where the grid has more coefficients than there are samples, the prior fills the gaps between them: third
    derivatives, since fields of least second ones bend too little there (error of the order of the gap to the square).
    """
    generator = torch.Generator().manual_seed(0)
    points, test = inside(samples, generator), 0.97 * inside(5000, generator)
    nodes_inside = inside(40000, generator)  # where the field is wanted, as a recording's mask would say
    light = rg.Smoother(
        knots=None, nodes=nodes, divergence=1e-3, curvature=1e-4, order=3, damping=1e-6, wall=None, no_slip=None
    ).fixed()
    start = clock()
    field = light.fit(points, flow(points, 2.0), divergence_points=torch.cat([nodes_inside, test]))
    row = took(start) | {"gradient": field.solution.gradient, "iterations": field.solution.iterations}
    exact = flow(test, 2.0)
    return row | {"error": float((field(test, outside=0.0) - exact).norm() / exact.norm())}


def clock() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def took(start: tuple[float, float]) -> dict:
    return {"seconds": time.perf_counter() - start[0], "cpu_seconds": time.process_time() - start[1]}


def one_row(solver: str, samples: int, nodes: tuple[int, ...]) -> dict:
    """Run one line of the tables in this process."""
    before = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    runs = {
        "direct": lambda rows: run_direct(rows, None),
        "direct, float32 factor": lambda rows: run_direct(rows, None, single=True),
        "direct, torch reference": lambda rows: run_direct(rows, "reference"),
        "next frame, same weights": run_next_frame,
        "next frame, new weights": lambda rows: run_new_weights(rows, samples, nodes),
        "LSQR, matrix-free": lambda rows: run_krylov(rows, "lsqr", False),
        "LSQR, CSR and transpose": lambda rows: run_krylov(rows, "lsqr", True),
        "LSMR, CSR and transpose": lambda rows: run_krylov(rows, "lsmr", True),
        "SciPy LSQR": lambda rows: run_scipy(rows, "lsqr", True),
        "SciPy LSMR": lambda rows: run_scipy(rows, "lsmr", True),
        "SciPy LSQR, first iterations": lambda rows: run_scipy(rows, "lsqr", False),
    }
    row = run_accuracy(samples, nodes) if solver == "noise-free fit" else runs[solver](system(samples, nodes))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "solver": solver,
        "samples": samples,
        "nodes": list(nodes),
        "megabytes": (peak - before) / 1e6,
    } | row


def plan(quick: bool) -> list[tuple[str, int, tuple[int, ...]]]:
    if quick:
        nodes = (16, 10, 10)
        solvers = ("direct", "direct, float32 factor", "direct, torch reference")
        frames = ("next frame, same weights", "next frame, new weights")
        rows = [(s, 3000, nodes) for s in (*solvers, *frames, "LSQR, CSR and transpose", "SciPy LSQR")]
        return rows + [("noise-free fit", 20000, n) for n in ((16, 8, 8), (24, 12, 12))]
    nodes = (32, 16, 16)
    ours = ("direct", "direct, float32 factor", "next frame, same weights", "next frame, new weights")
    rows = [(solver, samples, nodes) for samples in (20000, 200000) for solver in ours]
    rows += [("SciPy LSQR", 20000, nodes), ("SciPy LSQR, first iterations", 200000, nodes)]
    grids = ((16, 8, 8), (24, 12, 12), (32, 16, 16), (48, 24, 24), (64, 32, 32))
    rows += [("noise-free fit", samples, n) for n in grids for samples in (20000, 100000)]
    others = ("direct, torch reference", "LSQR, CSR and transpose", "LSMR, CSR and transpose", "SciPy LSMR")
    return rows + [(solver, 20000, nodes) for solver in (*others, "LSQR, matrix-free")]


def show(row: dict) -> None:
    grid = "x".join(map(str, row["nodes"]))
    gradient = "" if row["gradient"] is None else f"{row['gradient']:.0e}"
    error = f"  error {row['error']:.5f}" if "error" in row else ""
    head = f"{row['solver']:32s} {row['samples']:7d} {grid:9s}"
    cost = f"{row['seconds']:8.2f} s {row['cpu_seconds']:8.2f} cpu s {row['megabytes']:6.0f} MB"
    print(f"{head} {cost} {row['iterations']:6d} it {gradient:>6s}{error}", flush=True)


def draw(rows: list[dict], path: Path) -> None:
    """CPU seconds of the solvers, and the error over the knot grid."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), constrained_layout=True)
    timed = [row for row in rows if "error" not in row and row["gradient"] is not None]
    names = list(dict.fromkeys(row["solver"] for row in timed))
    counts = sorted({row["samples"] for row in timed})
    for shift, samples in enumerate(counts):
        own = [row for row in timed if row["samples"] == samples]
        places = [names.index(row["solver"]) + 0.4 * shift for row in own]
        bars = left.barh(places, [row["cpu_seconds"] for row in own], 0.4, label=f"{samples} samples")
        left.bar_label(bars, fmt="%.2g", padding=2, fontsize=8)
    left.set(xscale="log", xlabel="CPU seconds to a true relative gradient of 1e-6", yticks=range(len(names)))
    left.set_yticklabels(names)
    left.margins(x=0.15)
    left.invert_yaxis()
    left.legend()
    fits = [row for row in rows if "error" in row]
    for samples in sorted({row["samples"] for row in fits}):
        own = [row for row in fits if row["samples"] == samples]
        right.loglog([row["nodes"][0] for row in own], [row["error"] for row in own], "o-", label=f"{samples} samples")
    ticks = sorted({tuple(row["nodes"]) for row in fits})
    right.set_xticks([n[0] for n in ticks], ["x".join(map(str, n)) for n in ticks], fontsize=8)
    right.minorticks_off()
    right.set(xlabel="coefficients per axis", ylabel="relative error of a noise-free fit")
    right.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small problem, under a minute")
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--png", type=Path, help="also draw them here")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--row", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.row:
        solver, samples, nodes = json.loads(options.row)
        print(json.dumps(one_row(solver, samples, tuple(nodes))))
        return
    rows = []
    for line in plan(options.quick):
        command = [sys.executable, __file__, "--row", json.dumps(line), "--threads", str(options.threads)]
        threads = {name: str(options.threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        env = os.environ | threads | {"OMP_WAIT_POLICY": "passive"}
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=env)
        rows.append(json.loads(done.stdout))
        show(rows[-1])
        if options.json:
            write_table(options.json, {"rows": rows, "threads": options.threads}, SOURCES)
    if options.png:
        draw(rows, options.png)


if __name__ == "__main__":
    main()
