"""Tracers carried by a flow, forwards or backwards in time: dx/dt = u(x, t).

Classical Runge-Kutta of fourth order (Kutta 1901), all tracers side by side. A step is a part of a frame interval short
enough that nothing moves by more than `courant` spacings. After each step tracers beyond the wall are set back on it,
and those beyond an open orifice leave and stay where they left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

import geometry

from .moving_flow import MovingFlow, MovingWalls

__all__ = ["Tracers", "carry", "residence_time", "seed_blood"]

STEADY = 1e-12


@dataclass(frozen=True)
class Tracers:
    """Where tracers have come.

    Args:
        time: of the positions that are kept `(K,)`, s, in the order in which they were passed.
        paths: `(K, n, D)`, m; where a tracer has left, its last place.
        left_through: region `(n,)`; 0: it is still in the blood.
        left_at: `(n,)`, s; nan: it is still in the blood.
    """

    time: np.ndarray
    paths: Tensor
    left_through: Tensor
    left_at: Tensor

    @property
    def positions(self) -> Tensor:
        """Last positions `(n, D)`, m."""
        return self.paths[-1]


def carry(
    flow: MovingFlow,
    points: ArrayLike | Tensor,
    start: float,
    end: float,
    *,
    walls: MovingWalls | None = None,
    courant: float = 1.0,
    keep: ArrayLike = (),
) -> Tracers:
    """Carry tracers from `start` to `end`, s; backwards where `end` lies before `start`.

    Args:
        flow: the velocities.
        points: `(n, D)`, m, at `start`.
        start: s.
        end: s.
        walls: what turns tracers back and lets them out; `None`: nothing does.
        courant: spacings that the fastest blood of a frame interval may move in a step.
        keep: times between `start` and `end`, s, at which positions are kept beside those two.

    Raises:
        ValueError: `courant` is not positive or a time to keep does not lie between the two.
    """
    if not courant > 0:
        raise ValueError(f"carry: courant must be positive, not {courant}")
    marks = _marks(start, end, np.asarray(keep, np.float64))
    place = torch.as_tensor(points, dtype=flow.frames.dtype, device=flow.frames.device).clone()
    left_through = torch.zeros(len(place), dtype=torch.long, device=place.device)
    left_at = place.new_full((len(place),), float("nan"))
    reach = courant * min(flow.grid.spacing)
    paths, inside = [place.clone()], torch.arange(len(place), device=place.device)
    for before, after in zip(marks[:-1], marks[1:], strict=True):
        times = _steps(flow, float(before), float(after), reach)
        for t, following in zip(times[:-1], times[1:], strict=True):
            if len(inside) == 0:
                break
            moved = _step(flow, place[inside], float(t), float(following))
            if walls is not None:
                moved, left = walls.meet(moved, float(following))
                gone = inside[left > 0]
                left_through[gone], left_at[gone] = left[left > 0], float(following)
                place[inside] = moved
                inside = inside[left == 0]
            else:
                place[inside] = moved
        paths.append(place.clone())
    return Tracers(marks, torch.stack(paths), left_through, left_at)


def _steps(flow: MovingFlow, before: float, after: float, reach: float) -> list[float]:
    """Times from `before` to `after`, s, between which nothing moves by more than `reach`, m."""
    times = [before]
    for begin, end, speed in flow.pieces(before, after):
        count = max(1, int(np.ceil(abs(end - begin) * max(speed, STEADY) / reach - 1e-9)))
        times += np.linspace(begin, end, count + 1)[1:].tolist()
    return times


def _marks(start: float, end: float, keep: np.ndarray) -> np.ndarray:
    low, high = min(start, end), max(start, end)
    if ((keep < low) | (keep > high)).any():
        raise ValueError(f"carry: times to keep must lie between {start:g} and {end:g} s")
    order = np.unique(np.concatenate([[low], keep, [high]]))
    return order if end >= start else order[::-1]


def _step(flow: MovingFlow, x: Tensor, t: float, following: float) -> Tensor:
    h = following - t
    first, middle, last = flow.field(t), flow.field(t + 0.5 * h), flow.field(following)
    a = flow.sample(first, x)
    b = flow.sample(middle, x + 0.5 * h * a)
    c = flow.sample(middle, x + 0.5 * h * b)
    d = flow.sample(last, x + h * c)
    return x + h / 6 * (a + 2 * (b + c) + d)


def residence_time(forwards: Tracers, backwards: Tracers) -> tuple[Tensor, Tensor]:
    """Time (s) from entering to leaving of tracers `(n,)` carried both ways from one instant, and whether it is all.

    Where a tracer neither enters nor leaves in the time that was traced, the time counts as far as it was: a lower
    bound, and the second result `(n,)` is False.
    """
    entered = torch.where(backwards.left_through > 0, backwards.left_at, float(backwards.time[-1]))
    gone = torch.where(forwards.left_through > 0, forwards.left_at, float(forwards.time[-1]))
    # both start at one instant, but a periodic flow may number it differently forwards and backwards
    stay = (gone - float(forwards.time[0])) + (float(backwards.time[0]) - entered)
    return stay, (backwards.left_through > 0) & (forwards.left_through > 0)


def seed_blood(grid: geometry.Grid, mask: ArrayLike, count: int, generator: torch.Generator) -> Tensor:
    """`count` points `(count, D)`, m, evenly likely anywhere in the cells of the mask's nodes.

    Args:
        grid: the nodes.
        mask: bool `(*shape)`.
        count: number of points.
        generator: of random numbers, on the CPU.

    Raises:
        ValueError: the mask has no node.
    """
    nodes = torch.from_numpy(np.flatnonzero(np.asarray(mask, bool)))
    if len(nodes) == 0:
        raise ValueError("seed_blood: the mask has no node")
    # stratified: every node gets its share, the rest by chance
    number = torch.cat(
        [
            nodes.repeat(count // len(nodes)),
            nodes[torch.randperm(len(nodes), generator=generator)[: count % len(nodes)]],
        ]
    )
    jitter = torch.rand((count, grid.dimension), generator=generator, dtype=torch.float64) - 0.5
    return grid.nodes()[number] + jitter * torch.tensor(grid.spacing, dtype=torch.float64)
