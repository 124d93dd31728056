"""A learned denoiser: convolutions that see velocity, confidence and mask, and say what to add to a Gaussian's answer.

Trained on flows that our own simulator makes in ventricles of other shapes and beats than the phantom's, measured with
other seeds and at noise levels in between and around the two that it is judged at.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import geometry
from torchsph.ultrasound import NoiseModel, measure_noise

from .. import tuning
from ..frames import confidence
from . import gaussian

FWHM = 3e-3  # m, of the Gaussian that it starts from
LEVELS = (0.7, 1.3, 2.2)  # of the noise of the first of the two measurements


class Network(nn.Module):
    """Residual convolutions over (n, 8, z, y, x): Gaussian's answer, measurement, confidence, mask."""

    def __init__(self, width: int = 16, depth: int = 4) -> None:
        super().__init__()
        sizes = [8, *[width] * depth]
        self.layers = nn.ModuleList(nn.Conv3d(a, b, 3, padding=1) for a, b in zip(sizes[:-1], sizes[1:], strict=True))
        self.last = nn.Conv3d(width, 3, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # it begins as the Gaussian

    def forward(self, seen: Tensor) -> Tensor:
        """(n, 3, z, y, x) in units of the flow's RMS speed."""
        value = seen
        for number, layer in enumerate(self.layers):
            found = torch.nn.functional.silu(layer(value))
            value = found if number == 0 else value + found
        return (seen[:, :3] + self.last(value)) * seen[:, 7:8]


def seen(recording: geometry.Recording) -> tuple[Tensor, float]:
    """What the network is given, (T, 8, z, y, x), and the unit of speed, m/s."""
    weight = confidence(recording)
    smooth = gaussian.fit(recording, fwhm=FWHM)
    mask = np.asarray(recording.mask, bool)
    unit = float(np.sqrt((smooth**2).sum() / mask.sum()))
    field = np.where(weight[:, None] > 0, np.nan_to_num(recording.velocity), 0.0)
    stack = np.concatenate([smooth / unit, np.clip(field / unit, -5, 5), weight[:, None], mask[:, None]], 1)
    return torch.from_numpy(stack.astype(np.float32)), unit


def training_flows(count: int, seed: int) -> list[geometry.Recording]:
    """True flows in ventricles drawn around the tuning one."""
    draw, flows = np.random.default_rng(seed), []
    for _ in range(count):
        size, across = 1 + 0.15 * draw.uniform(-1, 1, 2)
        shape = replace(
            tuning.SHAPE,
            length=tuning.SHAPE.length * size,
            semi_major=tuning.SHAPE.semi_major * size,
            semi_minor=tuning.SHAPE.semi_minor * max(across, 1.0),
            aortic_centre=(0.0042, float(draw.uniform(-0.0015, 0.0005))),
            beat=replace(tuning.SHAPE.beat, stroke_fraction=float(draw.uniform(0.3, 0.5))),
        )
        flows.append(tuning.truth(spacing=2.2e-3, shape=shape))
    return flows


def trained(flows: list[geometry.Recording], *, steps: int, seed: int) -> Network:
    """Train on frames drawn at random, mirrored at random, with noise drawn anew every 30 steps."""
    torch.manual_seed(seed)
    network, draw = Network(), np.random.default_rng(seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=4e-3, total_steps=steps)
    for step in range(steps):
        if step % 30 == 0:
            flow, level = flows[int(draw.integers(len(flows)))], float(draw.choice(LEVELS))
            noise = NoiseModel(lateral=0.06 * level, axial=0.025 * level, outliers=0.01 * level)
            measured = measure_noise(flow, noise, seed=int(draw.integers(1 << 30)))
            inputs, unit = seen(measured)
            target = torch.from_numpy(np.nan_to_num(flow.velocity) / unit).float()
        frames = torch.from_numpy(draw.integers(len(inputs), size=2))
        given, wanted = inputs[frames], target[frames]
        if draw.random() < 0.5:  # mirrored at y = 0, which turns round that component
            given, wanted = given.flip(3).clone(), wanted.flip(3).clone()
            given[:, [1, 4]] *= -1
            wanted[:, 1] *= -1
        optimiser.zero_grad()
        error = (network(given) - wanted).square() * given[:, 7:8]
        (error.sum() / given[:, 7].sum()).backward()
        optimiser.step()
        schedule.step()
    return network


@lru_cache(maxsize=1)
def _network(flows: int, steps: int, seed: int, kept: Path | None) -> Network:
    file = None if kept is None else kept / f"denoiser-{flows}-{steps}-{seed}.pt"
    if file is not None and file.is_file():
        network = Network()
        network.load_state_dict(torch.load(file, weights_only=True))
        return network
    network = trained(training_flows(flows, seed), steps=steps, seed=seed)
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.save(network.state_dict(), file)
    return network


def fit(
    recording: geometry.Recording, *, flows: int = 4, steps: int = 300, seed: int = 5, kept: Path | None = None
) -> np.ndarray:
    """Frame by frame, by a network trained on ``flows`` simulated beats; ``kept``: folder for its weights."""
    network = _network(flows, steps, seed, kept)
    inputs, unit = seen(recording)
    with torch.no_grad():
        found = torch.cat([network(part) for part in inputs.split(4)])
    return (found * unit).numpy()
