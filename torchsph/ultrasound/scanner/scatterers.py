"""Point scatterers of blood and tissue, carried along by a flow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .flow import Flow


@dataclass(frozen=True)
class Box:
    """The region that is kept filled with scatterers.

    Args:
        lower: (D,), m, the lowest corner, in the order x, y, z.
        upper: (D,), m, the highest corner.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.lower) != len(self.upper) or not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"a box needs lower < upper on every axis, got {self.lower!r} and {self.upper!r}")

    @property
    def sides(self) -> tuple[float, ...]:
        """Lengths (D,), m."""
        return tuple(b - a for a, b in zip(self.lower, self.upper, strict=True))

    @property
    def volume(self) -> float:
        """Volume, m^D."""
        return math.prod(self.sides)

    def contains(self, points: Tensor) -> Tensor:
        """Whether points (n, D), m, lie inside: (n,) bool."""
        return ((points >= points.new_tensor(self.lower)) & (points <= points.new_tensor(self.upper))).all(1)


@dataclass(frozen=True, eq=False)
class Cloud:
    """A set of n scatterers.

    Args:
        position: (n, D), m.
        amplitude: (n,), complex, of mean power 1 where it is blood.
        tissue: (n,), bool.
    """

    position: Tensor
    amplitude: Tensor
    tissue: Tensor


def seed_cloud(
    box: Box,
    flow: Flow,
    time: float,
    density: float,
    generator: torch.Generator,
    *,
    dtype: torch.dtype = torch.float32,
) -> Cloud:
    """Scatterers uniformly at random in a box, of power 1 and random phase.

    Args:
        box: what is filled.
        flow: tells blood from tissue.
        time: s.
        density: scatterers per m^D.
        generator: draws places and phases, on the device of the cloud.
        dtype: precision of the positions.
    """
    if not density > 0:
        raise ValueError(f"scatterer density must be positive (per m^D), got {density!r}")
    count = max(1, round(density * box.volume))
    position = _uniform(box, count, generator, dtype)
    position = position[position[:, -1].argsort()]  # neighbours in memory meet in the cache when they are gridded
    return Cloud(position, _amplitudes(count, generator, dtype), ~flow.blood(position, time))


def advance(position: Tensor, flow: Flow, time: float, step: float) -> Tensor:
    """Positions (n, D), m, some time later, by classical Runge-Kutta.

    Args:
        position: (n, D), m.
        flow: what moves them.
        time: s, when they are there.
        step: s, of either sign.
    """
    k1 = flow.velocity(position, time)
    k2 = flow.velocity(position + 0.5 * step * k1, time + 0.5 * step)
    k3 = flow.velocity(position + 0.5 * step * k2, time + 0.5 * step)
    k4 = flow.velocity(position + step * k3, time + step)
    return position + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def carry(
    cloud: Cloud, box: Box, flow: Flow, time: float, step: float, density: float, generator: torch.Generator
) -> Cloud:
    """The cloud at ``time + step``: moved, without those that left ``box``, and reseeded at the inflow.

    What flows in is what came from outside: uniform random candidates whose path back leaves the box. So a
    cloud that was uniform stays so, and no scatterer inside is disturbed.

    Args:
        cloud: at ``time``.
        box: what is kept filled.
        flow: what moves the scatterers.
        time: s.
        step: s.
        density: scatterers per m^D.
        generator: draws what flows in.
    """
    position = advance(cloud.position, flow, time, step)
    inside = box.contains(position)
    kept = Cloud(position[inside], cloud.amplitude[inside], cloud.tissue[inside])
    candidates = _uniform(box, max(1, round(density * box.volume)), generator, position.dtype)
    farthest = (position - cloud.position).norm(dim=1).max() * 1.5 if len(position) else 0.0
    lower, upper = candidates.new_tensor(box.lower), candidates.new_tensor(box.upper)
    rim = torch.minimum(candidates - lower, upper - candidates).amin(1) <= farthest
    candidates = candidates[rim]
    inflow = candidates[~box.contains(advance(candidates, flow, time + step, -step))]
    return _joined(kept, _fresh(inflow, flow, time + step, generator))


def reseed(
    cloud: Cloud,
    box: Box,
    flow: Flow,
    time: float,
    density: float,
    generator: torch.Generator,
    *,
    per_cell: float = 100.0,
) -> Cloud:
    """Even out a density that a flow has changed: new scatterers in thin cells, fewer in crowded ones.

    Only cells more than four Poisson deviations off are brought back to the mean, so a uniform random cloud is
    left alone.

    Args:
        cloud: at ``time``.
        box: what is kept filled.
        flow: tells blood from tissue.
        time: s.
        density: scatterers per m^D.
        generator: draws who leaves and who comes.
        per_cell: scatterers in a cell on average.
    """
    cells = [max(1, round(side * (density / per_cell) ** (1 / len(box.sides)))) for side in box.sides]
    mean = density * box.volume / math.prod(cells)
    home = _cell_number(cloud.position, box, cells)
    count = torch.bincount(home, minlength=math.prod(cells))
    off = (count - mean).abs() > 4 * math.sqrt(mean)
    leave = torch.where(off & (count > mean), 1 - mean / count.clamp_min(1), 0.0)[home]
    chance = torch.rand(len(home), generator=generator, device=home.device)
    stay = chance >= leave
    kept = Cloud(cloud.position[stay], cloud.amplitude[stay], cloud.tissue[stay])
    lacking = torch.where(off & (count < mean), mean - count, 0.0).round().long()
    target = torch.repeat_interleave(torch.arange(len(lacking), device=home.device), lacking)
    position = _in_cells(target, box, cells, generator, cloud.position)
    return _joined(kept, _fresh(position, flow, time, generator))


def _fresh(position: Tensor, flow: Flow, time: float, generator: torch.Generator) -> Cloud:
    return Cloud(position, _amplitudes(len(position), generator, position.dtype), ~flow.blood(position, time))


def _joined(first: Cloud, second: Cloud) -> Cloud:
    return Cloud(
        torch.cat([first.position, second.position]),
        torch.cat([first.amplitude, second.amplitude]),
        torch.cat([first.tissue, second.tissue]),
    )


def _uniform(box: Box, count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    device = generator.device
    unit = torch.rand((count, len(box.lower)), generator=generator, dtype=dtype, device=device)
    return unit.new_tensor(box.lower) + unit * unit.new_tensor(box.sides)


def _amplitudes(count: int, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Of one strength and any phase: fewer make speckle fully developed than if strengths varied too."""
    phase = 2 * math.pi * torch.rand(count, generator=generator, dtype=dtype, device=generator.device)
    return torch.polar(torch.ones_like(phase), phase)


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
