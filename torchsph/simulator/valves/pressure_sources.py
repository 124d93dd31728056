"""Open valves as timed pressure sources, softened at the source (Grønli 2017, eqs. 3.3 and 3.4)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

import geometry
from torchsph.pairs.vectors import per_particle

from ..schemes.valve_models import PressureSource
from ..state.clock import Clock
from ..state.particles import Particles
from ..state.record import Record
from .accounts import note_passed
from .model import Pressure, ValveModel, ValveSetting


class PressureSources(ValveModel):
    """Potential V = Q / r around the centre of each open orifice, with Q from continuity.

    The flux q(t) = dV/dt through the orifice, spread over a half-sphere around its centre, has the radial speed
    q / (2 pi r^2); changing it needs the acceleration (dq/dt) / (2 pi r^2) towards the cavity, so Q = dq/dt / (2 pi)
    in 3.4 (in a plane: half-circle, dq/dt / (pi r)). A core radius replaces r by sqrt(r^2 + core^2).

    Raises:
        ValueError: a valve has a given pressure, which a source cannot keep.
    """

    does_work = True
    takes_strength = True

    def __init__(self, model: PressureSource, setting: ValveSetting) -> None:
        scene, units = setting.scene, setting.units
        given = [valve.region for valve in scene.valves if valve.pressure is not None]
        if given:
            raise ValueError(f"valves at a given pressure (regions {given}) need Reservoir, not PressureSource")
        if scene.walls is None:
            raise ValueError("pressure sources need walls, whose volume says how strong they are")
        self.motion, self.valves, self.units, self._setting = scene.walls, scene.valves, units, setting
        self._density, self._dimension = scene.fluid.density, scene.dimension
        self._core: dict[int, float] = {}
        self._track: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        openings = geometry.orifices(self.motion)
        for valve in scene.valves:
            # a source stands at the largest opening of its region
            largest = max((o for o in openings if o.label == valve.region), key=lambda o: o.area(self.motion.time[0]))
            planes = [largest.at(float(t)) for t in self.motion.time]
            area = float(np.mean([plane.area for plane in planes]))
            radius = math.sqrt(area / math.pi) if scene.dimension == 3 else 0.5 * area
            self._core[valve.region] = model.core * radius / units.length
            centre = np.stack([plane.centroid for plane in planes]) / units.length
            self._track[valve.region] = (centre, np.stack([plane.normal for plane in planes]))

    def strength(self, time: float) -> float:
        """d^2 V / dt^2 of the cavity (m^3/s^2), by central differences of the exact dV/dt over a millisecond."""
        step = 1e-3
        early, late = self._known(time - step), self._known(time + step)
        if late <= early:
            return 0.0
        return (self.motion.volume_rate(late) - self.motion.volume_rate(early)) / (late - early)

    def acceleration(self, particles: Particles, clock: Clock) -> Tensor | None:
        """-grad V of the open valves at the particles, times the valve strength, (N, D); None where none is open."""
        if not clock.open_regions:
            return None
        strength = per_particle(clock.valve_strength, particles.member)
        by_sources = self._acceleration(particles, clock.open_regions, clock.of_members(particles.members))
        return by_sources * (strength[:, None] if isinstance(strength, Tensor) else strength)

    def _acceleration(self, particles: Particles, open_regions: tuple[int, ...], times: Tensor) -> Tensor:
        """At strength 1, at each member's own time (members,), s."""
        unit = self.units.length**self._dimension / self.units.time**2
        moments, which = torch.unique(times, return_inverse=True)
        known = [float(moment) for moment in moments]
        share = [self.strength(time) / unit / len(open_regions) for time in known]
        part = torch.tensor(share).to(particles.position)[which][particles.member][:, None]
        total = torch.zeros_like(particles.position)
        for region in open_regions:
            centre = torch.stack([self._centre(region, time) for time in known])[which]
            offset = particles.position - centre.index_select(0, particles.member)
            square = (offset * offset).sum(1, keepdim=True) + self._core[region] ** 2
            if self._dimension == 3:
                total = total + part / (2.0 * math.pi) * offset / square**1.5
            else:
                total = total + part / math.pi * offset / square
        return total

    def finished(
        self, particles: Particles, clock: Clock, time: float, record: Record, pressure: Pressure
    ) -> Particles:
        """Take out the particles that are more than a spacing beyond an open orifice, and count them."""
        gone = torch.zeros(particles.count, dtype=torch.bool, device=particles.position.device)
        for number, valve in enumerate(self.valves):
            if valve.region not in clock.open_regions:
                continue
            left = (self._height(particles.position, valve.region, time) > 1.0) & ~gone
            if bool(left.any()):
                some = particles.select(left)
                note_passed(record, some, number, pressure(some), self.units, self._density, entered=False)
            gone |= left
        return particles.select(~gone) if bool(gone.any()) else particles

    def beyond(self, position: Tensor, clock: Clock) -> Tensor:
        """(n,) bool: points (n, D) less than half a spacing before the plane of an open orifice, or behind it."""
        beyond = super().beyond(position, clock)
        for region in clock.open_regions:
            beyond |= self._height(position, region, clock.middle) > -0.5
        return beyond

    def _height(self, position: Tensor, region: int, time: float) -> Tensor:
        """Outward distance (n,) from the plane of an orifice."""
        return ((position - self._centre(region, time)) * self._normal(region, time)).sum(1)

    def _centre(self, region: int, time: float) -> Tensor:
        """Centre (D,) of an orifice at ``time`` (s), internal."""
        return self._between_keys(self._track[region][0], time)

    def _normal(self, region: int, time: float) -> Tensor:
        """Outward normal (D,) of an orifice at ``time`` (s)."""
        return self._between_keys(self._track[region][1], time)

    def _between_keys(self, track: np.ndarray, time: float) -> Tensor:
        """What a track (T, D) of key frames is at ``time`` (s), linear in between."""
        key, place, _ = self.motion.locate(self._known(time))
        row = track[key] if place == 0 else (1 - place) * track[key] + place * track[key + 1]
        return torch.as_tensor(row, dtype=self._setting.dtype, device=self._setting.device)

    def _known(self, time: float) -> float:
        """A time (s) at which the motion is known: the same with a period, else the nearest one."""
        return time if self.motion.period else min(max(time, float(self.motion.time[0])), float(self.motion.time[-1]))
