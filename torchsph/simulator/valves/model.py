"""What every valve model is asked: the interface between the valves of a scene and a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsph.pairs.interface import Backend

from ..scene import Scene
from ..state.clock import Clock
from ..state.particles import Particles
from ..state.record import Record
from ..state.units import Units
from .pressure_reservoirs import PressureReservoirs

# p / rho0 (N,) of particles, internal
Pressure = Callable[[Particles], Tensor]


@dataclass(frozen=True)
class ValveSetting:
    """What a valve model is made for.

    Attributes:
        scene: with walls and valves.
        units: internal units.
        support_radius: of the smoothing kernel, internal.
        compressible: whether the scheme has an equation of state.
        wrapped_time: the time (s) among the walls' key frames that a time (s) stands for.
        period: (D,), internal, of the periodic box, or None.
        device: of the particles.
        dtype: of the particles.
    """

    scene: Scene
    units: Units
    support_radius: float
    compressible: bool
    wrapped_time: Callable[[float], float]
    period: Tensor | None
    device: str
    dtype: torch.dtype


class ValveModel:
    """Valves that stay shut; others override what they do otherwise.

    A model holds nothing that a run changes, so that runs share it: the present time comes as a clock. Internal units,
    all members at once.

    Attributes:
        has_buffers: whether there can be particles that the valves move (``Particles.kind``).
        buffers: openings behind which there can be particles that the valves move.
        does_work: whether ``acceleration`` may be other than None.
        takes_strength: whether a run's valve strength acts.
    """

    buffers = 0
    has_buffers = False
    does_work = False
    takes_strength = False

    def acceleration(self, particles: Particles, clock: Clock) -> Tensor | None:
        """Acceleration (N, D) of particles by open valves, or None."""
        return None

    def volume_deficit_rate(self, particles: Particles, clock: Clock) -> Tensor:
        """By how much of the cavity's volume, per time, each member's particles should grow to fill it: (members,)."""
        return torch.zeros(particles.members, dtype=particles.mass.dtype, device=particles.mass.device)

    def opened(self, particles: Particles, clock: Clock) -> Particles:
        """Particles at the beginning of an interval, with what valves need that have just opened or shut."""
        return particles

    def driven(self, particles: Particles, clock: Clock, *, channel: bool = False) -> Particles:
        """Particles with the velocity that buffers have now; with ``channel`` also free channels behind outlets."""
        return particles

    def exchange(
        self, particles: Particles, clock: Clock, record: Record, pressure: Pressure, stepping: Tensor
    ) -> tuple[Particles, bool]:
        """Particles, those that have crossed an opening noted and changed; True where they were renumbered.

        Only the members ``stepping`` (members,) bool are looked at: the others wait for them at the interval's end.
        """
        return particles, False

    def finished(
        self, particles: Particles, clock: Clock, time: float, record: Record, pressure: Pressure
    ) -> Particles:
        """Particles at the end, ``time`` (s), of an interval."""
        return particles

    def beyond(self, position: Tensor, clock: Clock) -> Tensor:
        """(n,) bool: points (n, D) at an open valve or behind it, where the walls' distance knows no end.

        Of the middle of the interval, an instant that all members have in common.
        """
        return torch.zeros_like(position[:, 0], dtype=torch.bool)

    def imposing_points(self, particles: Particles, clock: Clock) -> Tensor:
        """Where particles look up a field that is imposed on them, (N, D)."""
        return particles.position

    def split_points(self, clock: Clock) -> Tensor | None:
        """Points (n, D) where a field that is imposed tells how openings share what they pass, or None."""
        return None

    def open_points(self, clock: Clock) -> Tensor | None:
        """Points (n, D) just inside openings, where a field tells what all of them pass together, or None."""
        return None

    def through_open(self, velocity: Tensor, clock: Clock) -> Tensor:
        """Flux inwards (members,) of a field (members, n, D) at ``open_points``."""
        return velocity.new_zeros(len(velocity))

    def note_split(self, velocity: Tensor, clock: Clock) -> None:
        """Note how openings share what they pass, from a field (members, n, D) at ``split_points``."""

    def pressure_reservoirs(self, backend: Backend) -> PressureReservoirs | None:
        """What drives the buffers of valves with a given pressure, or None without any, so that it costs nothing."""
        return None
