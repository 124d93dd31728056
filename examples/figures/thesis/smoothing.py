"""What imposing on particles and fetching again smooths, and what a spline does (Grønli 2017, figs. 4.7 and 4.8).

A field is put on particles and fetched at once, over the number of particles; splines are fitted without penalties,
over the number of coefficients. Absolute errors, and relative to the frame's mean speed. Beside the particles stands
what their kernels do by themselves: the same weights summed over a lattice so dense that it is their integral.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.ndimage import binary_erosion

import regularize
import torchsph as ts
from torchsph.pairs import choose_backend
from torchsph.pairs.moving_least_squares import fetch_at
from torchsph.simulator.transfer.fetching import FETCH_RADIUS
from torchsph.simulator.transfer.imposing import fill_beyond, impose_at

from ..material import Material, per_frame_error
from ..record import Claim, Result
from ..style import COLOUR, axes

SPACINGS = (2.4e-3, 1.9e-3, 1.5e-3, 1.2e-3, 1.0e-3)  # m
COARSE = (3.0e-3, 2.2e-3)  # m, of the fast variant
NODES = ((8, 6, 6), (12, 8, 8), (16, 10, 10), (22, 13, 13), (28, 16, 16), (32, 18, 18))
DENSE = 3  # lattice points per particle spacing that stand for the integral
LOOSE = {"solver": "lsqr", "tolerance": 3e-2, "strict": False, "max_iterations": 8}


def make(material: Material) -> Result:
    """Errors over the frames by particle number and by number of coefficients."""
    spacings = COARSE if material.fast else SPACINGS
    nodes = NODES[1:4:2] if material.fast else NODES
    truth = material.truth
    frames = np.array([truth.frames - 1]) if material.fast else np.arange(0, truth.frames, 16)
    part = truth.select(frames)
    mask, true = np.asarray(part.mask, bool), np.nan_to_num(part.velocity)
    particles: dict[str, list[dict[str, float]]] = {"thesis": [], "default": []}
    kernels = []
    middle = len(frames) // 2
    for preset, spacing in product(particles, spacings):

        def passed(preset: str = preset, spacing: float = spacing) -> list[dict[str, float]]:
            fetched, exact, known, count = particle_errors(material, part.time, spacing, preset)
            alone = _kernel_alone(material, int(frames[middle]), fetched[middle], known[middle], spacing)
            return [_summary(fetched, exact, known, count), alone]

        whole, alone = material.part(f"{preset} {spacing}", passed)
        particles[preset].append(whole)
        if preset == "default":
            kernels.append(alone)
    splines: dict[str, list[dict[str, float]]] = {"exact solver": [], "loose LSQR": []}
    for name, one in product(splines, nodes):

        def fitted(
            one: tuple[int, int, int] = one, options: dict = LOOSE if "LSQR" in name else {}
        ) -> dict[str, float]:
            return _summary(spline_fields(material, part.time, one, options), true, mask)

        splines[name].append(material.part(f"{name} {one}", fitted))
    numbers = {
        "spacing_m": list(spacings),
        "particles": [int(row["particles"]) for row in particles["default"]],
        "coefficients": [int(np.prod(one)) for one in nodes],
        "impose_and_fetch": particles,
        "kernel_alone": kernels,
        "spline": splines,
    }
    return Result(numbers, _claims(numbers), material.settings(frames=len(frames)), lambda: _draw(numbers))


def particle_errors(
    material: Material, times: np.ndarray, spacing: float, preset: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Fetched and true fields (T, 3, *shape), m/s, where both are known (T, *shape), and the number of particles."""
    truth = material.truth
    model = ts.Simulator(material.scene(spacing), ts.preset(preset))
    fetched, true, known, count = [], [], [], 0
    for time in times:
        frame = int(np.abs(truth.time - time).argmin())
        mask = torch.from_numpy(np.array(truth.mask[frame], bool))
        run = model.start(float(time), seed=material.seed)
        run.impose(truth.grid, torch.from_numpy(np.nan_to_num(truth.velocity[frame])), mask)
        found = run.fetch(truth.grid, mask)
        fetched.append(found.value[0].numpy())
        known.append((mask & found.covered[0]).numpy())
        true.append(np.nan_to_num(truth.velocity[frame]))
        count = max(count, run.particles.count)
    return np.stack(fetched), np.stack(true), np.stack(known), count


def spline_fields(
    material: Material, times: np.ndarray, nodes: tuple[int, int, int], options: dict[str, object]
) -> np.ndarray:
    """Splines without penalties at the nodes of the mask, (T, 3, *shape), m/s."""
    truth, fields = material.truth, []
    points = truth.grid.nodes().double()
    smoother = regularize.Smoother(
        knots=None,
        nodes=nodes,
        divergence=None,
        wall=None,
        no_slip=None,
        curvature=None,
        damping=1e-6,
        automatic=None,
        robust=None,
        **options,
    )
    for time in times:
        frame = int(np.abs(truth.time - time).argmin())
        inside = torch.from_numpy(np.array(truth.mask[frame], bool).reshape(-1))
        samples = torch.from_numpy(np.nan_to_num(truth.velocity[frame]).reshape(3, -1)).double().T[inside]
        field = smoother.fit(points[inside], samples, torch.ones(len(samples), dtype=torch.float64))
        out = np.zeros((3, truth.grid.size))
        out[:, inside.numpy()] = field(points[inside], outside=0.0).T.numpy()
        fields.append(out.reshape(3, *truth.grid.shape))
    return np.stack(fields)


def _kernel_alone(
    material: Material, frame: int, fetched: np.ndarray, known: np.ndarray, spacing: float
) -> dict[str, float]:
    """NRMSE by particles, and by their kernels' integral, of a frame.

    At nodes that the walls are out of reach of, with the same two weights; ``offset_cells`` is the shift of the true
    field that explains most of what the particles do differently; an offset of half a cell would make it 0.5.
    """
    truth = material.truth
    grid, mask = truth.grid, torch.from_numpy(np.array(truth.mask[frame], bool))
    true = torch.from_numpy(np.nan_to_num(truth.velocity[frame])).double()
    deep = torch.from_numpy(binary_erosion(known, iterations=math.ceil(FETCH_RADIUS * spacing / min(grid.spacing))))
    nodes = grid.nodes().double()[deep.reshape(-1)]
    dense = spacing / DENSE
    low, high = nodes.min(0).values - 3 * spacing, nodes.max(0).values + 3 * spacing
    ticks = [torch.arange(float(a), float(b), dense, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    lattice = torch.cartesian_prod(*ticks)
    filled = fill_beyond(true[None], mask, grid, None)[0]
    there, _ = impose_at(lattice, grid, filled, torch.ones(grid.shape, dtype=torch.float64))
    owner, owners = torch.zeros(len(nodes), dtype=torch.int64), torch.zeros(len(lattice), dtype=torch.int64)
    integral = fetch_at(
        choose_backend("auto", "cpu"), nodes / dense, owner, lattice / dense, owners, there, FETCH_RADIUS * DENSE
    ).value
    exact = true.reshape(3, -1)[:, deep.reshape(-1)].T
    own = torch.from_numpy(fetched).double().reshape(3, -1)[:, deep.reshape(-1)].T
    scale = exact.norm()
    gradient = torch.stack(
        [
            torch.from_numpy(np.gradient(true.numpy(), axis=3 - k)).reshape(3, -1)[:, deep.reshape(-1)].T
            for k in range(3)
        ],
        -1,
    )
    offset = torch.linalg.lstsq(gradient.reshape(-1, 3), (integral - own).reshape(-1, 1)).solution
    return {
        "nodes": int(deep.sum()),
        "by_particles": float((own - exact).norm() / scale),
        "by_kernels": float((integral - exact).norm() / scale),
        "offset_cells": float(offset.norm()),
    }


def _summary(found: np.ndarray, true: np.ndarray, mask: np.ndarray, count: int = 0) -> dict[str, float]:
    """Mean over the frames of the RMS error, m/s, and of it over the frame's RMS speed; NRMSE of all."""
    wrong, right = per_frame_error(found, true, mask)
    pooled = np.sqrt((wrong**2).sum() / (right**2).sum())
    return {
        "particles": count,
        "rms_error": float(wrong.mean()),
        "relative": float((wrong / right).mean()),
        "nrmse": float(pooled),
    }


def _claims(numbers: dict) -> list[Claim]:
    fine, loose = (numbers["spline"][name][-1]["nrmse"] for name in ("exact solver", "loose LSQR"))
    own = numbers["impose_and_fetch"]["default"][-1]["nrmse"]
    over = [row["by_particles"] / row["by_kernels"] - 1 for row in numbers["kernel_alone"]]
    offset = max(row["offset_cells"] for row in numbers["kernel_alone"])
    return [
        Claim(
            "more particles smooth less",
            all(a["nrmse"] > b["nrmse"] for a, b in _pairs(numbers["impose_and_fetch"]["default"])),
            "NRMSE " + ", ".join(f"{row['nrmse']:.3f}" for row in numbers["impose_and_fetch"]["default"]),
        ),
        Claim(
            "imposing and fetching smooths slightly more than the kernels do, as if by an offset of half a cell",
            bool(offset > 0.25 or max(over) > 0.05),
            f"the least-squares offset is at most {offset:.3f} cells; error over that of the kernels' integral: "
            + ", ".join(f"{1 + x:.3f}" for x in over),
        ),
        Claim(
            "the spline saturates at a higher error than the particles",
            bool(fine > own),
            f"at the most coefficients the spline's NRMSE is {fine:.4f}, at the most particles theirs {own:.4f}",
        ),
        Claim(
            "loose tolerances of LSQR are the hidden floor of the spline's error",
            bool(loose > 1.5 * fine),
            f"{loose:.4f} with eight iterations of LSQR, {fine:.4f} with an exact solver",
        ),
    ]


def _pairs(rows: list) -> zip:
    return zip(rows, rows[1:], strict=False)


def _draw(numbers: dict) -> Figure:
    figure, panels = axes(2, 2, 10, 3.0)
    for row, (key, label) in enumerate((("rms_error", "RMS error, m/s"), ("relative", "error / RMS speed"))):
        for name, found in numbers["impose_and_fetch"].items():
            panels[row, 0].loglog(
                [one["particles"] for one in found], [one[key] for one in found], "o-", color=COLOUR[name], label=name
            )
        for name, found in numbers["spline"].items():
            style = "s-" if name == "exact solver" else "s--"
            panels[row, 1].loglog(numbers["coefficients"], [one[key] for one in found], style, label=name)
        panels[row, 0].set_ylabel(label)
        for panel in panels[row]:
            panel.grid(which="both", alpha=0.3)
            panel.legend(fontsize=8)
    panels[0, 0].set_title("imposed on particles and fetched")
    panels[0, 1].set_title("spline without penalties")
    panels[1, 0].set_xlabel("particles")
    panels[1, 1].set_xlabel("coefficients per component")
    return figure
