"""From the surfaces of a human left ventricle to a flow over its beat, with every setting at its default.

    python examples/human_ventricle.py FOLDER [PERIOD]

FOLDER holds one OBJ file (mm) for each time of a beat of PERIOD s (0.85), endocardium cut open at the valves, as biv-me
writes them (github.com/UOA-Heart-Mechanics-Research/biv-me, example/fitted-models). There is no measurement of the flow
inside: our own simulation with particles of 2.5 mm stands in for the blood, seen on a grid of 3 mm in 36 frames.
"""

import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import geometry
import torchsph as ts
from torchsph.evaluation.metrics import evaluate
from torchsph.ultrasound import NoiseModel, measure_noise


def truth(folder: Path, period: float, frames: int = 36) -> geometry.Recording:
    """A beat from rest: the larger opening (1, mitral) is open while the ventricle fills, the other while it ejects."""
    files = sorted(folder.glob("*.obj"))
    surfaces = [geometry.with_lids(geometry.read_surface(file, scale=1e-3, mend=False)) for file in files]
    stack, first = np.stack([s.vertices for s in [*surfaces, surfaces[0]]]), surfaces[0]
    keys = np.linspace(0, period, len(stack))
    motion = geometry.WallMotion.through(keys, stack, first.faces, first.region, period=period)
    at = np.linspace(0, period, frames, endpoint=False)
    wall = geometry.Wall(np.stack([motion.vertices(t) for t in at]), first.faces, first.region)
    grid = geometry.Grid.covering(stack.min((0, 1)), stack.max((0, 1)), 3e-3)
    inside = np.stack([geometry.grid_winding(grid, v, first.faces) > 0 for v in wall.vertices])
    still = np.zeros((frames, 3, *grid.shape), np.float32)
    least = at[np.argmin([motion.volume(t) for t in at])]
    valves = np.array([[1, least, period], [2, 0, least]])
    blank = geometry.Recording(at, grid, still, inside, wall, 1060.0, 4e-3, period, valve_intervals=valves)
    run = ts.make_model(blank, spacing=2.5e-3).start(0.0)
    for frame, mask in enumerate(torch.from_numpy(inside)):
        run.advance(at[frame])
        still[frame] = run.fetch(grid, mask).value[0].numpy()
    return replace(blank, velocity=still)


if __name__ == "__main__":
    true = truth(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 0.85)
    measured, began = measure_noise(true, NoiseModel(), seed=0), time.process_time()
    found = {name: one.recording for name, one in ts.run_methods(measured, ("spline", "ensemble")).items()}
    for name, recording in {"measured": measured, **found}.items():
        print(f"{name:10} relative error {evaluate(recording, true)['nrmse'].value:.3f}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    print(f"{time.process_time() - began:.0f} s of one core, at most {1e-9 * peak:.2f} GB")
