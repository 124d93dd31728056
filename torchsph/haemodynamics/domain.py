"""Where a flow is: its grid, masks, walls and valves over the frames; what the quantities of one frame share."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import geometry

from .fields.acceleration import pressure_gradient
from .fields.derivatives import Derivatives, WallSamples
from .flow_rate import OpeningFlow
from .pressure import PressureSolver, pressure_difference

__all__ = ["PROBE", "DomainFrame", "FieldQuantities", "FlowDomain", "long_axis"]

Array = NDArray[np.float64]

PROBE = 2.0
"""The pressure at base and apex is the mean within this many spacings of a point as far inside on the long axis."""

PRECISION = 1e-8
"""Of the pressure's equations, relative: far below what any field is known to."""


class FieldQuantities(NamedTuple):
    """What is read out of fields of one frame.

    Attributes:
        curves: every quantity of the domain's catalogue, `(*batch)`.
        pressure: `(*batch, *shape)`, Pa, of mean 0 over each part of the mask; `None` in a plane through which blood
            passes.
        vorticity: `(*batch, D, *shape)`, 1/s; in a plane `(*batch, *shape)`.
    """

    curves: dict[str, Array]
    pressure: Array | None
    vorticity: Array


@dataclass(frozen=True)
class FlowDomain:
    """The blood's domain over the frames: everything of a recording but the velocity.

    Args:
        grid: the nodes.
        time: `(T,)`, s.
        mask: bool `(T, *shape)`.
        motion: of the wall.
        rho: density, kg/m^3.
        mu: dynamic viscosity, Pa s.
        intervals: rows (region, opens, closes), s: when an orifice is open.
        inlet: region of the inlet.
        outlet: region of the outlet.
        cut: whether it is a plane cut out of a flow in space, through which blood passes.
    """

    grid: geometry.Grid
    time: Array
    mask: NDArray[np.bool_]
    motion: geometry.WallMotion
    rho: float
    mu: float
    intervals: Array = field(default_factory=lambda: np.zeros((0, 3)))
    inlet: int = 1
    outlet: int = 2
    cut: bool = False

    @classmethod
    def from_recording(cls, recording: geometry.Recording) -> FlowDomain:
        """The domain of a recording, in space or in a plane."""
        motion = geometry.WallMotion.from_recording(recording)
        mask = np.asarray(recording.mask, bool)
        valves = recording.valve_intervals_or_derived()
        return cls(recording.grid, recording.time, mask, motion, recording.rho, recording.mu, valves, cut=recording.cut)

    @property
    def events(self) -> list[float]:
        """Times, s, at which a valve opens or closes."""
        times = np.unique(self.intervals[:, 1:])
        return [float(t) for t in times[np.isfinite(times)]]

    def is_open(self, region: int, t: float) -> bool:
        """Whether the orifice of a region is open at `t`, s; one that is never mentioned always is."""
        rows = self.intervals[self.intervals[:, 0] == region]
        return len(rows) == 0 or bool(((rows[:, 1] <= t) & (t <= rows[:, 2])).any())

    def openings(self, mask: NDArray[np.bool_], wall: geometry.WallPoints, t: float) -> dict[str, SignedOpening]:
        """Inlet and outlet where they are open at `t`, s, by the names of their curves.

        Args:
            mask: `(*shape)` of that time.
            wall: points of the wall at that time, orifices included.
            t: s.
        """
        there = [int(label) for label in np.unique(wall.region[wall.region > 0])]
        passing, found = [label for label in there if self.is_open(label, t)], {}
        for name, region, sign in (("flow_inlet", self.inlet, 1.0), ("flow_outlet", self.outlet, -1.0)):
            if region in passing:
                others = [label for label in passing if label != region]
                found[name] = SignedOpening(sign, OpeningFlow(self.grid, mask, wall, region, others))
        return found


class SignedOpening(NamedTuple):
    """An opening and the sign of its valve's own direction: 1 into the blood, -1 out of it."""

    sign: float
    opening: OpeningFlow


def long_axis(surface: geometry.Surface) -> tuple[Array, Array]:
    """Base (mean of the orifices' middles) and apex (the wall's farthest point from it), `(D,)`, m.

    Raises:
        ValueError: the surface has no orifice.
    """
    labels = np.unique(surface.region[surface.region > 0])
    if len(labels) == 0:
        raise ValueError("long_axis: the wall has no orifice (region above 0), so that it has no base")
    base = np.mean([surface.centroids[surface.region == label].mean(0) for label in labels], axis=0)
    apex = surface.vertices[np.argmax(((surface.vertices - base) ** 2).sum(1))]
    return base, apex


class DomainFrame:
    """What a frame's quantities share, made once for all of its fields.

    Args:
        domain: masks, walls and fluid.
        number: of the frame.
        sampler: of the domain's walls, made once for all frames; `None`: one of its own.

    Attributes:
        volume: that the wall encloses, m^3; in a plane its area, m^2.
        base: middle of the openings `(D,)`, m; nan in a plane that meets none (a short axis).
        apex: the wall's farthest point from it `(D,)`, m, or nan like it.
        walled: derivatives that know the wall's velocity.
        free: those of the blood's nodes alone.
    """

    def __init__(self, domain: FlowDomain, number: int, sampler: geometry.WallSampler | None = None) -> None:
        walls = geometry.WallSampler(domain.motion, min(domain.grid.spacing)) if sampler is None else sampler
        self.domain, self.time, self.mask = domain, float(domain.time[number]), domain.mask[number]
        surface = domain.motion.surface(self.time)
        self.volume = surface.volume
        self.base, self.apex = (np.full(2, np.nan),) * 2
        if surface.dimension == 3 or (surface.region > 0).any():
            self.base, self.apex = long_axis(surface)
        self.wall = walls.at(self.time)
        self.walled = Derivatives(domain.grid, self.mask, WallSamples.of(self.wall))
        self.free = Derivatives(domain.grid, self.mask)
        self._openings = domain.openings(self.mask, self.wall, self.time)

    @property
    def axis(self) -> Array:
        """Unit vector from apex to base."""
        return np.asarray((self.base - self.apex) / np.linalg.norm(self.base - self.apex), np.float64)

    def flows(self, velocity: ArrayLike, divergence: ArrayLike | None = None) -> dict[str, Array]:
        """Flows through inlet and outlet `(*batch)`, positive in the direction of their valve; 0 where they are shut.

        Args:
            velocity: `(*batch, D, *shape)`, m/s.
            divergence: see `OpeningFlow.rate`.
        """
        rates = {name: sign * opening.rate(velocity, divergence) for name, (sign, opening) in self._openings.items()}
        nothing = np.zeros(np.shape(velocity)[: -1 - self.domain.grid.dimension])
        return {name: rates.get(name, nothing) for name in ("flow_inlet", "flow_outlet")}

    def pressure(self, acceleration: ArrayLike, velocity: ArrayLike) -> Array:
        """Relative pressure `(*batch, *shape)`, Pa, from a material acceleration, m/s^2, and its velocity, m/s."""
        slope = pressure_gradient(acceleration, self.free.laplacian(velocity), self.domain.rho, self.domain.mu)
        return self._solver.solve(slope)

    def pressure_difference(self, pressure: ArrayLike) -> Array:
        """Base less apex `(*batch)`, Pa, of a pressure `(*batch, *shape)`, Pa; nan where there is no base."""
        if not np.isfinite(self.base).all():
            return np.full(np.shape(pressure)[: -self.domain.grid.dimension], np.nan)
        probe = PROBE * min(self.domain.grid.spacing)
        upper, lower = self.base - probe * self.axis, self.apex + probe * self.axis
        return pressure_difference(pressure, self.mask, self.domain.grid, upper, lower, probe)

    @cached_property
    def _solver(self) -> PressureSolver:
        return PressureSolver(self.domain.grid, self.mask, PRECISION)
