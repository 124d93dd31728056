"""Reading how openings that are open together share what they pass: off a field, or off their buffers."""

from __future__ import annotations

import torch
from torch import Tensor

from ..state.clock import Clock
from ..state.particles import CHANNEL, RESERVOIR, Particles
from .cavity_volume import CavityVolume
from .flux_split import FluxSplit, fluxes, takers
from .openings import OpeningPlane, Openings

# depth inside the orifice (spacings) at which the profile of an imposed field is read
MOUTH = 0.5


class SharedFlux:
    """Reads the split of the flux between a scene's openings; what it reads is kept by the run's clock.

    Args:
        openings: of the scene's valves.
        volume: of the cavity.
    """

    def __init__(self, openings: Openings, volume: CavityVolume) -> None:
        self._openings, self._volume = openings, volume

    def points(self, clock: Clock) -> Tensor | None:
        """Points (n, D) just inside openings that share what they pass, where their fluxes are read; None: none do."""
        free = self._free(clock)
        if len(free) < 2:
            return None
        return torch.cat([plane.quadrature() - MOUTH * plane.normal for _, plane in free])

    def read_field(self, velocity: Tensor, clock: Clock) -> None:
        """Read the split off a field (members, n, D) at ``points``."""
        free = self._free(clock)
        self._keep(_through([plane for _, plane in free], velocity), free, clock)

    def open_points(self, clock: Clock) -> Tensor | None:
        """Points (n, D) just inside all openings that are open, or None."""
        active = self._openings.active(clock)
        return torch.cat([plane.quadrature() - MOUTH * plane.normal for _, plane in active]) if active else None

    def through_open(self, velocity: Tensor, clock: Clock) -> Tensor:
        """Flux inwards (members,) of a field (members, n, D) at ``open_points`` through all of them together."""
        return _through([plane for _, plane in self._openings.active(clock)], velocity).sum(1)

    def read_buffers(self, particles: Particles, clock: Clock) -> None:
        """Read the split off the velocities of the openings' buffers, where a run goes on; nothing without them."""
        free = self._free(clock)
        behind = [(particles.kind == RESERVOIR + n) | (particles.kind == CHANNEL - n) for n, _ in free]
        if len(free) < 2 or not all(bool(buffer.any()) for buffer in behind):
            return
        read = []
        for (_, plane), buffer in zip(free, behind, strict=True):
            along = torch.where(buffer, ((particles.velocity - plane.velocity) * plane.normal).sum(1), 0.0)
            count = particles.per_member(buffer.to(along.dtype), "sum").clamp_min(1.0)
            read.append(-plane.area * particles.per_member(along, "sum") / count)
        self._keep(torch.stack(read, 1), free, clock)

    def _free(self, clock: Clock) -> list[tuple[int, OpeningPlane]]:
        return takers(self._openings, self._openings.active(clock))

    def _keep(self, read: Tensor, free: list[tuple[int, OpeningPlane]], clock: Clock) -> None:
        """Keep fluxes (members, n) that were read of some openings, brought to sum to what they pass together."""
        numbers = tuple(n for n, _ in free)
        found = fluxes(self._openings, clock, self._volume.rate(clock.of_members(len(read))))
        total = torch.stack([found[n] for n in numbers]).sum(0)
        areas = total.new_tensor([plane.area for _, plane in free])
        clock.flux_split = FluxSplit.balanced(numbers, read, areas, total)


def _through(planes: list[OpeningPlane], velocity: Tensor) -> Tensor:
    """Flux inwards (members, openings) of a field (members, n, D) at the openings' points, one after another."""
    counts = [len(plane.quadrature()) for plane in planes]
    read = [
        -plane.area * ((part - plane.velocity) @ plane.normal).mean(1)
        for plane, part in zip(planes, velocity.split(counts, dim=1), strict=True)
    ]
    return torch.stack(read, 1)
