"""Forecasting on a grid: impose velocities on particles, advance, fetch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import geometry
from geometry.arguments import checked
from torchsph.pairs.moving_least_squares import Fetched

from .simulator import Simulation, Simulator
from .transfer.carried_detail import CarriedDetail
from .transfer.checks import check_grid


@checked
@dataclass(frozen=True)
class Transfer:
    """How a grid forecast is put together from the particles.

    Attributes:
        fade: time (s) over which the correction below fades, or None for the plain fetch. Imposing and fetching
            loses detail that the particles cannot carry; the forecast is the fetched field plus that loss (initial
            grid minus the field fetched at once), brought along with fluid and walls (``CarriedDetail``), times
            exp(-lead / fade). For noisy input use None: the loss is noise.
        projections: how often the imposed velocities are projected on fields without divergence before the first step;
            needs complete-kernel walls, and is left out with others.
    """

    fade: float | None = 0.03
    projections: int = 2

    def __post_init__(self) -> None:
        if self.fade is not None and not self.fade > 0:
            raise ValueError(f"Transfer.fade must be positive (s) or None, got {self.fade}")
        if self.projections < 0:
            raise ValueError(f"Transfer.projections must not be negative, got {self.projections}")


class GridForecast:
    """A forecast on its way: starts from velocity grids of all members, gives velocity grids at later times.

    Args:
        model: the simulator.
        grid: the nodes, m.
        velocity: (D, *shape) for one member or (members, D, *shape), m/s.
        mask: (*shape) bool, where it is known.
        time: s.
        transfer: between grid and particles.
        seed: of the particles.
        rates: keep what `rate` needs: one more fetch, of the start, where `transfer.fade` is None.

    Attributes:
        run: the simulation.
        shock: (members,) what the projection took from the imposed velocities (``Simulation.project``): how far the
            start is from a flow that the walls and the incompressible fluid allow. NaN where nothing is projected.
    """

    @checked
    def __init__(
        self,
        model: Simulator,
        grid: geometry.Grid,
        velocity: Tensor,
        mask: Tensor,
        time: float,
        transfer: Transfer,
        *,
        seed: int = 0,
        rates: bool = False,
    ) -> None:
        check_grid(grid, model.scene.dimension)
        if not isinstance(velocity, Tensor) or not isinstance(transfer, Transfer):
            kinds = f"{type(velocity).__name__} and {type(transfer).__name__}"
            raise TypeError(f"GridForecast needs a velocity that is a tensor and a Transfer, got {kinds}")
        batched = velocity if velocity.ndim == grid.dimension + 2 else velocity[None]
        self.grid, self.transfer, self.start_time = grid, transfer, time
        self.run: Simulation = model.start(time, members=batched.shape[0], seed=seed)
        self.run.impose(grid, batched, mask)
        self.shock = torch.full((len(batched),), math.nan, dtype=torch.float64)
        if transfer.projections and self.run.can_project:
            self.shock = self.run.project(transfer.projections).cpu()
        self._lost: CarriedDetail | None = None
        self._ends: list[tuple[float, Fetched]] | None = [] if rates else None  # the start and the last fetch
        if transfer.fade is None and self._ends is None:
            return
        kept = self.run.fetch(grid, mask)
        if self._ends is not None:
            self._ends = [(time, Fetched(kept.value, mask & kept.covered))]
        if transfer.fade is not None:
            known = mask & kept.covered
            lost = torch.where(known[:, None], batched.to(kept.value) - kept.value, torch.zeros_like(kept.value))
            self._lost = CarriedDetail(grid, lost, known.all(0), model.scene.walls, time)
            self.run.follow()

    @checked
    def at(self, time: float, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Advance to ``time`` (s) and fetch at the nodes of ``mask``.

        Returns velocity (members, D, *shape), m/s, 0 where uncovered, and covered (members, *shape) bool.
        """
        self.run.advance(time)
        found = self.run.fetch(self.grid, mask)
        if self._ends is not None:
            self._ends = [self._ends[0], (time, Fetched(found.value, mask & found.covered))]
        if self._lost is None or self.transfer.fade is None:
            return found.value, found.covered
        fading = math.exp(-(time - self.start_time) / self.transfer.fade)
        lost = self._lost.at(time, self.run.travelled(self.grid, mask).value, mask)
        return found.value + fading * lost * found.covered[:, None], found.covered

    def rate(self) -> Tensor:
        """Mean du/dt from the start to the last `at` (members, D, *shape), m/s^2; not a number where one is unknown.

        Of the particles' own fields at both ends: what the transfer has lost of the start, and what the first
        projection has taken, is in neither of them.
        """
        if self._ends is None or len(self._ends) < 2:
            raise ValueError("GridForecast.rate needs rates=True and a field fetched after the start (`at`)")
        (begin, first), (end, last) = self._ends
        known = first.covered & last.covered
        rate = (last.value - first.value) / (end - begin)
        return torch.where(known[:, None], rate, torch.nan)
