"""Splines with every setting at its default from an artery of .3 mm to a plane of pixels: error, seconds, memory.

    python examples/benchmarks/runs/scales.py [NAME ...] [--json FILE]

Exact flows with white noise of a tenth of their peak: Poiseuille flow in rigid tubes whose both ends are open, and a
Lamb-Oseen vortex in planes without walls. Three frames each, in a process of its own; seconds of one core a frame, and
what the run added to the process's memory, also by node of the mask.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

import geometry
import torchsph as ts
from examples.provenance import SPLINES, write_table

SOURCES = ("examples/benchmarks/runs/scales.py", *SPLINES)

TIME = np.array([0.0, 0.01, 0.02])
# radius, length and grid spacing of a tube, m; peak speed, m/s
TUBES = {
    "carotid, .3 mm": (3e-3, 20e-3, 0.3e-3, 0.8),
    "newborn's aorta, 1 mm": (4e-3, 30e-3, 1e-3, 0.8),
    "adult's aorta, 1.5 mm": (12e-3, 60e-3, 1.5e-3, 1.2),
    "adult's aorta, 3 mm": (12e-3, 90e-3, 3e-3, 1.2),
}
# nodes along each side of a plane, and their spacing, m
PLANES = {"plane of 64 x 64 pixels": (64, 0.25e-3), "plane of 256 x 256 pixels": (256, 0.25e-3)}


def tube(radius: float, length: float, spacing: float, peak: float) -> tuple[geometry.Recording, np.ndarray]:
    """Poiseuille flow with noise, and the true velocity."""
    surface = geometry.tube(radius, length, spacing)
    grid = geometry.Grid.covering(
        (-1.05 * radius, -1.05 * radius, 0.0), (1.05 * radius, 1.05 * radius, length), spacing
    )
    square = (grid.nodes().numpy()[:, :2] ** 2).sum(1).reshape(grid.shape) / radius**2
    true = np.zeros((len(TIME), 3, *grid.shape), np.float32)
    true[:, 2] = peak * np.clip(1 - square, 0.0, None)
    wall = geometry.Wall(surface.vertices, surface.faces, surface.region)
    rows = np.array([[1.0, -1.0, 1.0], [2.0, -1.0, 1.0]])
    return replace(noisy(true, grid, square < 0.999, peak), wall=wall, valve_intervals=rows), true


def plane(side: int, spacing: float) -> tuple[geometry.Recording, np.ndarray]:
    """A vortex with noise on a plane without walls, and the true velocity."""
    grid = geometry.Grid((0.0, 0.0), (spacing, spacing), (side, side))
    offset = grid.nodes().numpy() - 0.5 * spacing * (side - 1)
    core = 0.15 * spacing * side
    square = np.maximum((offset**2).sum(1), 1e-20)
    swirl = core * (1 - np.exp(-square / core**2)) / square
    flow = np.stack([-offset[:, 1] * swirl, offset[:, 0] * swirl]).astype(np.float32)
    true = np.broadcast_to(flow.reshape(1, 2, side, side), (len(TIME), 2, side, side)).copy()
    return noisy(true, grid, np.ones((side, side), bool), float(np.abs(true).max())), true


def noisy(true: np.ndarray, grid: geometry.Grid, mask: np.ndarray, peak: float) -> geometry.Recording:
    """The true velocity as it might be measured."""
    noise = 0.1 * peak * np.random.default_rng(0).standard_normal(true.shape)
    measured = np.where(mask, true + noise, 0).astype(np.float32)
    return geometry.Recording(TIME, grid, measured, mask, None, 1060.0, 4e-3)


def measure(name: str) -> dict[str, float]:
    """Error, seconds and memory of one scene, in this process."""
    torch.set_num_threads(1)
    recording, true = tube(*TUBES[name]) if name in TUBES else plane(*PLANES[name])
    mask, before = recording.mask[0], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.process_time()
    smooth = ts.smooth(recording)
    seconds = (time.process_time() - began) / len(TIME)
    grown = 1024.0 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    wrong, noise = smooth.velocity - true, recording.velocity - true
    left = ((wrong[:, :, mask] ** 2).sum() / (noise[:, :, mask] ** 2).sum()) ** 0.5
    return {"nodes": int(mask.sum()), "left": float(left), "seconds": seconds, "bytes": grown}


def main() -> None:
    """Measure the scenes asked for, each in a child, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="these scenes alone")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--json", type=Path, help="write the rows there")
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.names[0])))
        return
    rows = {}
    print(f"{'scene':28s}{'nodes':>8s}{'of noise':>9s}{'s/frame':>9s}{'us/node':>9s}{'MB':>7s}{'kB/node':>9s}")
    for name in options.names or [*TUBES, *PLANES]:
        call = [sys.executable, "-W", "ignore", __file__, name, "--child"]
        found = json.loads(subprocess.run(call, check=True, capture_output=True, text=True).stdout)
        rows[name] = found
        each = found["nodes"]
        print(
            f"{name:28s}{each:8d}{found['left']:9.2f}{found['seconds']:9.2f}{1e6 * found['seconds'] / each:9.0f}"
            f"{1e-6 * found['bytes']:7.0f}{1e-3 * found['bytes'] / each:9.1f}",
            flush=True,
        )
    if options.json:
        write_table(options.json, rows, SOURCES)


if __name__ == "__main__":
    main()
