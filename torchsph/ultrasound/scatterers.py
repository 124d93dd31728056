"""Point scatterers of blood and tissue, carried along by a flow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .flow import Flow


@dataclass(frozen=True)
class Box:
    """The region that is kept filled: ``lower`` and ``upper`` corners, x, y, z, m."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.lower) != len(self.upper) or not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"a box needs lower < upper on every axis, got {self.lower!r} and {self.upper!r}")

    @property
    def sides(self) -> tuple[float, ...]:
        return tuple(b - a for a, b in zip(self.lower, self.upper, strict=True))

    @property
    def volume(self) -> float:
        return math.prod(self.sides)

    def contains(self, points: Tensor) -> Tensor:
        return ((points >= points.new_tensor(self.lower)) & (points <= points.new_tensor(self.upper))).all(1)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Scatterers: ``position`` (n, D), m; ``amplitude`` (n,) complex, mean power 1; ``tissue`` (n,) bool."""

    position: Tensor
    amplitude: Tensor
    tissue: Tensor


def seed_cloud(
    box: Box, flow: Flow, time: float, density: float, generator: torch.Generator,
    *, dtype: torch.dtype = torch.float32,
) -> Cloud:  # fmt: skip
    """Scatterers uniformly at random in ``box``, ``density`` per m^D, with circular Gaussian amplitudes."""
    if not density > 0:
        raise ValueError(f"scatterer density must be positive (per m^D), got {density!r}")
    count = max(1, round(density * box.volume))
    position = _uniform(box, count, generator, dtype)
    return Cloud(position, _amplitudes(count, generator, dtype), ~flow.blood(position, time))


def advance(position: Tensor, flow: Flow, time: float, step: float) -> Tensor:
    """Positions (n, D) after ``step`` seconds (of either sign): the classical fourth-order Runge-Kutta method."""
    k1 = flow.velocity(position, time)
    k2 = flow.velocity(position + 0.5 * step * k1, time + 0.5 * step)
    k3 = flow.velocity(position + 0.5 * step * k2, time + 0.5 * step)
    k4 = flow.velocity(position + step * k3, time + step)
    return position + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def reseed(
    cloud: Cloud, box: Box, flow: Flow, time: float, generator: torch.Generator, *, cell: float = 1e-3
) -> tuple[Cloud, int]:
    """Put scatterers that left the box, or crowd a cell, where density has fallen; returns how many.

    Density is counted in cells of about ``cell`` metres. A cell gives away what exceeds the mean by three Poisson
    deviations, and receives in proportion to what it lacks, so a uniform random cloud is left alone. The moved
    ones are new scatterers: new amplitude, and blood or tissue by where they are put. Their number is constant.
    """
    cells = [max(1, round(side / cell)) for side in box.sides]
    inside = box.contains(cloud.position)
    home = _cell_number(cloud.position, box, cells)
    count = torch.bincount(home[inside], minlength=math.prod(cells)).to(cloud.position.dtype)
    mean = len(home) / math.prod(cells)
    surplus = (count - mean - 3 * math.sqrt(mean)).clamp_min(0)
    leave = (surplus / count.clamp_min(1))[home]
    chance = torch.rand(len(home), generator=generator, dtype=cloud.position.dtype, device=cloud.position.device)
    moved = ~inside | (chance < leave)
    number = int(moved.sum())
    lacking = (mean - count).clamp_min(0)
    if number == 0 or not lacking.any():
        return cloud, 0
    target = torch.multinomial(lacking.double(), number, replacement=True, generator=generator)
    position, amplitude, tissue = cloud.position.clone(), cloud.amplitude.clone(), cloud.tissue.clone()
    position[moved] = _in_cells(target, box, cells, generator, position)
    amplitude[moved] = _amplitudes(number, generator, position.dtype)
    tissue[moved] = ~flow.blood(position[moved], time)
    return Cloud(position, amplitude, tissue), number


def _uniform(box: Box, count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    device = generator.device
    unit = torch.rand((count, len(box.lower)), generator=generator, dtype=dtype, device=device)
    return unit.new_tensor(box.lower) + unit * unit.new_tensor(box.sides)


def _amplitudes(count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    parts = torch.randn((count, 2), generator=generator, dtype=dtype, device=generator.device)
    return torch.view_as_complex(parts * math.sqrt(0.5))


def _cell_number(position: Tensor, box: Box, cells: list[int]) -> Tensor:
    """Flat cell index (n,), x fastest; positions outside the box count into the nearest cell."""
    share = (position - position.new_tensor(box.lower)) / position.new_tensor(box.sides)
    number = torch.zeros(len(position), dtype=torch.long, device=position.device)
    for axis in reversed(range(len(cells))):
        number = number * cells[axis] + (share[:, axis] * cells[axis]).floor().long().clamp(0, cells[axis] - 1)
    return number


def _in_cells(target: Tensor, box: Box, cells: list[int], generator: torch.Generator, like: Tensor) -> Tensor:
    """Uniform random positions (n, D) in the cells numbered ``target`` (n,)."""
    unit = torch.rand((len(target), len(cells)), generator=generator, dtype=like.dtype, device=like.device)
    columns = []
    for axis, nodes in enumerate(cells):
        place = (target % nodes).to(like.dtype) + unit[:, axis]
        columns.append(box.lower[axis] + place * (box.sides[axis] / nodes))
        target = target // nodes
    return torch.stack(columns, 1)
