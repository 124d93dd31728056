"""Open valves as timed pressure sources (thesis 3.3, 3.4), softened at the source."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import geometry
from torchsph.pairs.vectors import per_particle

from ..scene import Scene
from ..schemes.valve_models import PressureSource
from ..state.energy import carried_energy, energy_unit
from ..state.particles import Particles
from ..state.record import Record
from ..state.units import Units


class Sources:
    """Potential V = Q / r around the centre of each open orifice, with Q from continuity.

    The flux q(t) = dV/dt through the orifice, spread over a half-sphere around its centre, has the radial speed
    q / (2 pi r^2); changing it needs the acceleration (dq/dt) / (2 pi r^2) towards the cavity, so Q = dq/dt / (2 pi)
    in 3.4 (in a plane: half-circle, dq/dt / (pi r)). A core radius replaces r by sqrt(r^2 + core^2).

    Attributes:
        push: (N, D), the last acceleration, internal, for the account of the work; None while all valves are shut.
    """

    def __init__(self, scene: Scene, model: PressureSource, units: Units, device: str, dtype: torch.dtype) -> None:
        self.motion, self.units, self.dtype, self.device = scene.walls, units, dtype, device
        self.valves = scene.valves
        self._core: dict[int, float] = {}
        self._track: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        openings = geometry.orifices(self.motion)
        for valve in scene.valves:
            # a source stands at the largest opening of its region
            mine = max((o for o in openings if o.label == valve.region), key=lambda o: o.area(self.motion.time[0]))
            planes = [mine.at(float(t)) for t in self.motion.time]
            area = float(np.mean([plane.area for plane in planes]))
            radius = math.sqrt(area / math.pi) if scene.dimension == 3 else 0.5 * area
            self._core[valve.region] = model.core * radius / units.length
            centre = np.stack([plane.centroid for plane in planes]) / units.length
            self._track[valve.region] = (centre, np.stack([plane.normal for plane in planes]))
        self.dimension, self._density = scene.dimension, scene.fluid.density
        self.push: Tensor | None = None

    def strength(self, time: float) -> float:
        """d^2 V / dt^2 of the cavity (m^3/s^2), by central differences of the exact dV/dt over a millisecond."""
        step = 1e-3
        early, late = self._known(time - step), self._known(time + step)
        if late <= early:
            return 0.0
        return (self.motion.volume_rate(late) - self.motion.volume_rate(early)) / (late - early)

    def acceleration(
        self, particles: Particles, open_regions: tuple[int, ...], times: Tensor, factor: float | Tensor = 1.0
    ) -> Tensor | None:
        """-grad V (3.4) of the open valves at the particles, (N, D), internal; None where none is open.

        ``factor`` on Q, a number or (members,).
        """
        self.push = None
        if open_regions:
            push, each = self._acceleration(particles, open_regions, times), per_particle(factor, particles.member)
            self.push = push * (each[:, None] if isinstance(each, Tensor) else each)
        return self.push

    def _acceleration(self, particles: Particles, open_regions: tuple[int, ...], times: Tensor) -> Tensor:
        time = float(times.mean()) if times.numel() else 0.0
        unit = self.units.length**self.dimension / self.units.time**2
        share = self.strength(time) / unit / len(open_regions)
        total = torch.zeros_like(particles.position)
        for region in open_regions:
            offset = particles.position - self._at(region, time, 0)
            square = (offset * offset).sum(1, keepdim=True) + self._core[region] ** 2
            if self.dimension == 3:
                total = total + share / (2.0 * math.pi) * offset / square**1.5
            else:
                total = total + share / math.pi * offset / square
        return total

    def without_gone(
        self,
        particles: Particles,
        open_regions: tuple[int, ...],
        time: float,
        record: Record,
        pressure: Callable[[Particles], Tensor],
    ) -> Particles:
        """Take out the particles that are more than a spacing beyond an open orifice, and count them."""
        gone = torch.zeros(particles.count, dtype=torch.bool, device=particles.position.device)
        for number, valve in enumerate(self.valves):
            if valve.region not in open_regions:
                continue
            height = ((particles.position - self._at(valve.region, time, 0)) * self._at(valve.region, time, 1)).sum(1)
            out = (height > 1.0) & ~gone
            if bool(out.any()):
                self._account(particles.select(out), number, record, pressure)
            gone |= out
        return particles.select(~gone) if bool(gone.any()) else particles

    def behind(self, position: Tensor, region: int, time: float) -> Tensor:
        """(n,) bool: points (n, D) less than half a spacing before the plane of an orifice, or behind it."""
        return ((position - self._at(region, time, 0)) * self._at(region, time, 1)).sum(1) > -0.5

    def _account(self, gone: Particles, valve: int, record: Record, pressure: Callable[[Particles], Tensor]) -> None:
        """Note the particles that have left through a valve."""
        energy = energy_unit(self.units, self._density, self.dimension)
        record.removed[:, valve] += gone.per_member(torch.ones_like(gone.member), "sum")
        record.outflow[:, valve] += gone.per_member(gone.mass.double(), "sum") * self.units.length**self.dimension
        record.energy_out[:, valve] += gone.per_member(carried_energy(gone, pressure(gone)), "sum") * energy

    def _at(self, region: int, time: float, which: int) -> Tensor:
        """Centre (which 0, internal) or outward normal (1) of an orifice, linear in time between key frames."""
        track = self._track[region][which]
        key, place, _ = self.motion.locate(self._known(time))
        row = track[key] if place == 0 else (1 - place) * track[key] + place * track[key + 1]
        return torch.as_tensor(row, dtype=self.dtype, device=self.device)

    def _known(self, time: float) -> float:
        """A time (s) at which the motion is known: the same with a period, else the nearest one."""
        return time if self.motion.period else min(max(time, float(self.motion.time[0])), float(self.motion.time[-1]))
