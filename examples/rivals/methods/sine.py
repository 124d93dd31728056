"""What the neural fields share: a sine network with its derivatives, samples in the flow's units, windows of frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

import geometry

from ..frames import confidence

WINDOW, OVERLAP = 8, 2  # frames fitted together; those that two windows share are blended


class SineField(nn.Module):
    """A network of sines (Sitzmann et al. 2020) from place and time (n, 4) to ``outputs`` numbers.

    Args:
        outputs: of the network.
        frequency: factor of the first layer: how fine it sees.
        width: of the hidden layers.
        depth: number of hidden layers.
        generator: of the initial weights.
    """

    def __init__(self, outputs: int, frequency: float, width: int, depth: int, generator: torch.Generator) -> None:
        super().__init__()
        sizes = [4, *[width] * depth, outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True))
        self.frequency = frequency
        for number, layer in enumerate(self.layers):
            bound = 1 / sizes[number] if number == 0 else math.sqrt(6 / sizes[number])
            with torch.no_grad():
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.uniform_(-bound, bound, generator=generator)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Values (n, outputs) and their derivatives (n, 4, outputs), carried along from layer to layer."""
        value, slope = self.frequency * points, self.frequency * torch.eye(4).expand(len(points), 4, 4)
        for layer in self.layers[:-1]:
            inner = layer(value)
            value, slope = inner.sin(), inner.cos()[:, None] * (slope @ layer.weight.T)
        last = self.layers[-1]
        return last(value), slope @ last.weight.T


@dataclass(frozen=True)
class Samples:
    """A window of a measurement in units of its own: places and times (n, 4), velocities (n, 3), weights (n,).

    ``wall``, ``normal``, ``moving``: places (k, 4), normals (k, 3) and normal velocities (k,) of walls, through which
    nothing goes. ``length`` m, ``duration`` s and ``speed`` m/s are the units.
    """

    places: Tensor
    velocity: Tensor
    weight: Tensor
    wall: Tensor
    normal: Tensor
    moving: Tensor
    length: float
    duration: float
    speed: float


def samples(recording: geometry.Recording, frames: range, power: float) -> Samples:
    """The samples of some frames."""
    nodes, middle = recording.grid.nodes().numpy(), np.mean([recording.grid.origin, recording.grid.upper], 0)
    length = 0.5 * float(np.max(np.array(recording.grid.upper) - recording.grid.origin))
    times = recording.time[frames.start : frames.stop]
    duration = length / 0.5  # s: what half a metre per second takes to cross the unit of length
    weights = confidence(recording) ** power
    motion = geometry.WallMotion.from_recording(recording)
    sampler = geometry.WallSampler(motion, 2 * float(min(recording.grid.spacing)))
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("places", "velocity", "weight", "wall", "normal", "moving")
    }

    def placed(points: np.ndarray, time: float) -> np.ndarray:
        return np.column_stack([(points - middle) / length, np.full(len(points), (time - times.mean()) / duration)])

    for frame in frames:
        time, known = float(recording.time[frame]), (weights[frame] > 0).reshape(-1)
        rows["places"].append(placed(nodes[known], time))
        rows["velocity"].append(np.nan_to_num(recording.velocity[frame]).reshape(3, -1).T[known])
        rows["weight"].append(weights[frame].reshape(-1)[known])
        wall = sampler.at(time)
        solid = wall.region == 0
        rows["wall"].append(placed(wall.points[solid], time))
        rows["normal"].append(wall.normals[solid])
        rows["moving"].append((wall.normals * wall.velocities).sum(1)[solid])
    found = {name: torch.from_numpy(np.concatenate(each)).float() for name, each in rows.items()}
    speed = float((found["weight"] * found["velocity"].square().sum(1)).sum() / found["weight"].sum()) ** 0.5
    found["velocity"], found["moving"] = found["velocity"] / speed, found["moving"] / speed
    return Samples(**found, length=length, duration=duration, speed=speed)


def fitted(
    recording: geometry.Recording,
    outputs: int,
    loss: Callable[[SineField, Samples, torch.Generator], Tensor],
    velocity: Callable[[Tensor, Tensor], Tensor],
    *,
    frequency: float,
    steps: int,
    power: float,
    width: int = 64,
    depth: int = 3,
    seed: int = 0,
) -> np.ndarray:
    """Train a field for each window of frames, and read it at the nodes: (T, 3, *shape), m/s.

    Args:
        recording: the measurement.
        outputs: of the network.
        loss: of the network on a window, with random numbers for its batch.
        velocity: (n, 3) from values and derivatives, in units of the window's speed.
        frequency: of the first layer.
        steps: of Adam, for each window.
        power: of the confidence.
        width: of the network.
        depth: of the network.
        seed: of weights and batches.
    """
    out = np.zeros(recording.velocity.shape, np.float64)
    share = np.zeros(recording.frames)
    mask = np.asarray(recording.mask, bool)
    for first in range(0, max(recording.frames - OVERLAP, 1), WINDOW - OVERLAP):
        frames = range(first, min(first + WINDOW, recording.frames))
        data = samples(recording, frames, power)
        generator = torch.Generator().manual_seed(seed + first)
        network = SineField(outputs, frequency, width, depth, generator)
        optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=4e-3, total_steps=steps)
        for _ in range(steps):
            optimiser.zero_grad()
            loss(network, data, generator).backward()
            optimiser.step()
            schedule.step()
        for number, frame in enumerate(frames):
            part = min(number + 1, len(frames) - number, OVERLAP + 1)
            out[frame][:, mask[frame]] += part * _read(network, velocity, recording, frame, frames, data).T
            share[frame] += part
    return (out / share[:, None, None, None, None]).astype(np.float32)


def _read(
    network: SineField,
    velocity: Callable[[Tensor, Tensor], Tensor],
    recording: geometry.Recording,
    frame: int,
    frames: range,
    data: Samples,
) -> np.ndarray:
    """Velocities (m, 3), m/s, at the nodes of a frame's mask."""
    nodes = recording.grid.nodes().numpy()[np.asarray(recording.mask[frame], bool).reshape(-1)]
    middle = np.mean([recording.grid.origin, recording.grid.upper], 0)
    since = float(recording.time[frame] - recording.time[frames.start : frames.stop].mean()) / data.duration
    places = np.column_stack([(nodes - middle) / data.length, np.full(len(nodes), since)])
    with torch.no_grad():
        found = [velocity(*network(part)) for part in torch.from_numpy(places).float().split(4096)]
    return torch.cat(found).numpy() * data.speed


def batch(data: Samples, size: int, generator: torch.Generator) -> Tensor:
    """Random indices (size,) of samples."""
    return torch.randint(len(data.places), (size,), generator=generator)


def misfit(found: Tensor, data: Samples, index: Tensor) -> Tensor:
    """Weighted Huber loss of velocities (n, 3) against samples; an outlier pulls no harder than one unit of speed."""
    weight = data.weight[index]
    error = (found - data.velocity[index]).square().sum(1)
    return (weight * (torch.sqrt(1 + error) - 1)).sum() / weight.sum()


def leak(network: SineField, velocity: Callable[[Tensor, Tensor], Tensor], data: Samples, index: Tensor) -> Tensor:
    """Mean square of what goes through the walls, at points of the walls."""
    through = (velocity(*network(data.wall[index])) * data.normal[index]).sum(1) - data.moving[index]
    return through.square().mean()
