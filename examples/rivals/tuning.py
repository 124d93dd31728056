"""The ventricle that rivals are tuned on: longer, wider, slower than the phantom, its valves elsewhere, its own seeds.

No measurement and no outside solver: our own simulation stands in for its blood.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import geometry
import torchsph as ts
from torchsph.ultrasound import NoiseModel, measure_noise

SHAPE = geometry.Ventricle(
    length=0.034,
    semi_major=0.024,
    semi_minor=0.0102,
    mitral_centre=(-0.0040, 0.0012),
    mitral_semi_axes=(0.0032, 0.0044),
    aortic_centre=(0.0042, -0.0010),
    aortic_radius=0.0032,
    beat=geometry.Beat(period=0.5, stroke_fraction=0.38, early=(0.26, 0.39), late=(0.37, 0.48), late_share=0.3),
)
# as the two measurements of the phantom have it
NOISE = {"measured": NoiseModel(), "noisy": NoiseModel(lateral=0.12, axial=0.05, outliers=0.03)}
START, FIRST, STOP, STEP = 0.22, 0.28, 0.40, 0.01  # s: from rest, what is kept, until when, a frame


def truth(spacing: float = 2e-3, shape: geometry.Ventricle = SHAPE, grid_spacing: float = 1e-3) -> geometry.Recording:
    """The filling wave from rest, a frame every 10 ms, by particles ``spacing`` (m) apart."""
    times = np.arange(START, STOP, STEP)
    still = shape.recording(times, grid_spacing=grid_spacing)
    run = ts.Simulator(ts.Scene.from_recording(still, spacing), ts.preset("default")).start(float(times[0]))
    field = np.zeros(still.velocity.shape, np.float32)
    for frame, time in enumerate(times):
        run.advance(float(time))
        field[frame] = run.fetch(still.grid, torch.from_numpy(np.array(still.mask[frame], bool))).value[0].numpy()
    return replace(still, velocity=field).select(times > FIRST - 1e-6)


def kept_truth(folder: Path) -> geometry.Recording:
    """`truth` as a file of a folder, made where it is not there."""
    file = folder / "tuning.h5"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        geometry.write_recording(str(file), truth())
    return geometry.read_recording(str(file))


def measurement(true: geometry.Recording, noise: str, seed: int = 977) -> geometry.Recording:
    """What a tracker would report of it at one of the two noise levels."""
    return measure_noise(true, NOISE[noise], seed)
