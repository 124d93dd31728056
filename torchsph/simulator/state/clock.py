"""The present time of every member of a run, and what holds for the interval that they are in."""

from __future__ import annotations

from copy import copy
from typing import Protocol

import torch
from torch import Tensor

from .particles import Particles


class Split(Protocol):
    """What openings that are open together carried when it was last read (``valves.flux_split``)."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """Of the openings."""

    @property
    def flux(self) -> Tensor:
        """(members, len(numbers)), internal, inwards."""

    def at(self, numbers: tuple[int, ...], areas: Tensor, total: Tensor) -> Tensor:
        """Fluxes (members, n) of some of the openings that sum to ``total`` (members,)."""


class Clock:
    """Present times of the members, inside an interval in which no valve opens or shuts.

    Attributes:
        open_regions: regions of the valves that are open in the interval.
        valve_strength: the run's factor on what drives the flow through open valves, a number or (members,).
        middle: s, of the interval.
        times: () or (members,) float64, s, the present time of all members or of each.
        flux_split: how openings that are open together share what they pass; None until it is read.
    """

    open_regions: tuple[int, ...]
    valve_strength: float | Tensor
    middle: float
    times: Tensor

    def __init__(self, device: str | torch.device) -> None:
        self._device = device
        self.flux_split: Split | None = None
        self.enter(0.0, 0.0, (), 1.0)

    def enter(self, start: float, stop: float, open_regions: tuple[int, ...], valve_strength: float | Tensor) -> None:
        """Go to the beginning of an interval between the times ``start`` and ``stop`` (s)."""
        self.open_regions, self.valve_strength = open_regions, valve_strength
        self.middle = 0.5 * (start + stop)
        self.at(start)

    def at(self, times: Tensor | float) -> None:
        """Set the present time of the members, s: (members,) float64 or one for all."""
        self.times = torch.as_tensor(times, dtype=torch.float64, device=self._device)
        self._first: float | None = None

    @property
    def first(self) -> float:
        """Present time of the first member, s, which stands for all where their openings are in the same place."""
        if self._first is None:
            self._first = float(self.times.reshape(-1)[0])
        return self._first

    def seen_by(self, group: Tensor) -> Clock:
        """The clock for some members, (members,) bool; the others stand at the time of the first of them."""
        other = copy(self)
        if self.times.ndim:
            other.at(torch.where(group, self.times, self.times[group][0]))
        return other

    def of_members(self, members: int) -> Tensor:
        """Present time of each member, s, (members,) float64."""
        return self.times.expand(members) if self.times.ndim == 0 else self.times

    def of_particles(self, particles: Particles) -> Tensor:
        """Present time of each particle's member, s, (N,) float64."""
        return self.of_members(particles.members).index_select(0, particles.member)
