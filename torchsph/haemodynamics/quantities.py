"""All scalars of a flow over its frames, for one field or for many members side by side.

Frame by frame: what depends on the mask and the walls alone (derivative operators, pressure equations, orifices) is
made once and serves all members, whose fields are read a few frames at a time: a stack on disk is never held whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import geometry

from .energy import energy_loss, integral, kinetic_energy
from .fields.acceleration import material_acceleration, pressure_gradient, time_derivative
from .fields.derivatives import Derivatives, WallSamples
from .flow_rate import OpeningFlow
from .force import axial_components, haemodynamic_force
from .pressure import PressureSolver, pressure_difference
from .vorticity import helicity_density, vorticity

__all__ = ["UNITS", "FieldQuantities", "FlowDomain", "FrameQuantities", "flow_quantities", "long_axis"]

Array = NDArray[np.float64]

UNITS = {
    "volume": "m3",
    "kinetic_energy": "J",
    "kinetic_energy_density": "J/m3",
    "energy_loss": "W",
    "vorticity_rms": "1/s",
    "helicity": "m/s2",
    "force_axial": "N",
    "force_across": "N",
    "pressure_difference": "Pa",
    "flow_inlet": "m3/s",
    "flow_outlet": "m3/s",
}
"""Quantities per frame; flows are positive in the direction of their valve: in at the inlet, out at the outlet."""

PROBE = 2.0
"""The pressure at base and apex is the mean within this many spacings of a point as far inside on the long axis."""


PRECISION = 1e-8
"""Of the pressure's equations, relative: far below what any field is known to."""


class FieldQuantities(NamedTuple):
    """What is read out of fields of one frame.

    Attributes:
        curves: every quantity of `UNITS`, `(*batch)`.
        pressure: `(*batch, *shape)`, Pa, of mean 0 over each part of the mask.
        vorticity: `(*batch, D, *shape)`, 1/s.
    """

    curves: dict[str, Array]
    pressure: Array
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

    @classmethod
    def from_recording(cls, recording: geometry.Recording) -> FlowDomain:
        """The domain of a recording.

        Raises:
            ValueError: it is a plane recording.
        """
        if recording.dimension != 3:
            raise ValueError("FlowDomain: the quantities of a whole flow need a recording in space, not in a plane")
        motion = geometry.WallMotion.from_recording(recording)
        mask = np.asarray(recording.mask, bool)
        valves = recording.valve_intervals_or_derived()
        return cls(recording.grid, recording.time, mask, motion, recording.rho, recording.mu, valves)

    @property
    def events(self) -> list[float]:
        """Times, s, at which a valve opens or closes."""
        times = np.unique(self.intervals[:, 1:])
        return [float(t) for t in times[np.isfinite(times)]]

    def is_open(self, region: int, t: float) -> bool:
        """Whether the orifice of a region is open at `t`, s; one that is never mentioned always is."""
        rows = self.intervals[self.intervals[:, 0] == region]
        return len(rows) == 0 or bool(((rows[:, 1] <= t) & (t <= rows[:, 2])).any())


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


def flow_quantities(
    domain: FlowDomain, velocity: NDArray[np.floating], *, sigma: ArrayLike | None = None, order: int = 2
) -> dict[str, Array]:
    """Every quantity of `UNITS` over time: `(*batch, T)`.

    Args:
        domain: masks, walls and fluid.
        velocity: `(*batch, T, D, *shape)`, m/s, with no batch axis or one; what is not finite counts as 0. Any array
            that can be sliced, an HDF5 dataset too.
        sigma: standard deviation of each component `(T, D, *shape)`, m/s: its variance is added to the kinetic energy.
            For the field of a mean, not for members.
        order: of accuracy in time of the acceleration: 2 or 4.

    Raises:
        ValueError: the velocity does not fit the domain.
    """
    shape, frames = np.shape(velocity), len(domain.time)
    if shape[-2 - domain.grid.dimension :] != (frames, domain.grid.dimension, *domain.grid.shape) or len(shape) > 6:
        raise ValueError(
            f"flow_quantities: the velocity must be (T, D, *shape) = {(frames, 3, *domain.grid.shape)} or a stack of "
            f"such, not {shape}"
        )
    sampler = geometry.WallSampler(domain.motion, min(domain.grid.spacing))
    deviations = [None] * frames if sigma is None else list(np.nan_to_num(np.asarray(sigma, np.float64)))
    rows = []
    for n in range(frames):
        near = list(range(max(n - order, 0), min(n + order + 1, frames)))
        fields, place = _frames_of(velocity, near), n - near[0]
        rate = time_derivative(fields, domain.mask[near], domain.time[near], place, order=order, events=domain.events)
        rows.append(FrameQuantities(domain, n, sampler).of(fields[place], rate, sigma=deviations[n])[0])
    return {name: np.stack([row[name] for row in rows], axis=-1) for name in UNITS}


class FrameQuantities:
    """The quantities of one frame, for any number of fields.

    Args:
        domain: masks, walls and fluid.
        number: of the frame.
        sampler: of the domain's walls, made once for all frames; `None`: one of its own.
    """

    def __init__(self, domain: FlowDomain, number: int, sampler: geometry.WallSampler | None = None) -> None:
        walls = geometry.WallSampler(domain.motion, min(domain.grid.spacing)) if sampler is None else sampler
        self.domain, self.time, self.mask = domain, float(domain.time[number]), domain.mask[number]
        grid, surface = domain.grid, domain.motion.surface(self.time)
        self.volume = surface.volume
        self.base, self.apex = long_axis(surface)
        self._walled = Derivatives(grid, self.mask, WallSamples.at(walls, self.time))
        self._free = Derivatives(grid, self.mask)
        self._solver = PressureSolver(grid, self.mask, PRECISION)
        self._openings = self._open_orifices(walls.at(self.time))

    def of(self, velocity: ArrayLike, rate: ArrayLike | None, *, sigma: ArrayLike | None = None) -> FieldQuantities:
        """Every quantity of `UNITS` `(*batch)`, and the relative pressure.

        Args:
            velocity: `(*batch, D, *shape)`, m/s, finite.
            rate: du/dt like it, m/s^2; `None` for a steady flow.
            sigma: standard deviation of each component `(D, *shape)`, m/s, for the kinetic energy.
        """
        domain, mask, speed = self.domain, self.mask, np.asarray(velocity, np.float64)
        cell, volume = domain.grid.cell_volume, self.volume
        gradient = self._walled.gradient(speed)
        curl = vorticity(gradient)
        acceleration = material_acceleration(speed, self._free.gradient(speed), rate)
        slope = pressure_gradient(acceleration, self._free.laplacian(speed), domain.rho, domain.mu)
        pressure = self._solver.solve(slope)
        force = haemodynamic_force(acceleration, mask, cell, domain.rho, volume=volume)
        along, across = axial_components(force, self.axis)
        energy = kinetic_energy(speed, mask, cell, domain.rho, sigma=sigma, volume=volume)
        curves = {
            "volume": np.broadcast_to(volume, np.shape(energy)),
            "kinetic_energy": energy,
            "kinetic_energy_density": energy / volume,
            "energy_loss": energy_loss(gradient, mask, cell, domain.mu, volume=volume),
            "vorticity_rms": np.sqrt(integral((curl**2).sum(-4), mask, cell, 1.0)),
            "helicity": integral(helicity_density(speed, curl), mask, cell, 1.0),
            "force_axial": along,
            "force_across": across,
            "pressure_difference": self.pressure_difference(pressure),
        }
        for name in ("flow_inlet", "flow_outlet"):
            sign, opening = self._openings.get(name, (0.0, None))
            curves[name] = np.zeros(np.shape(energy)) if opening is None else sign * opening.rate(speed)
        return FieldQuantities(curves, pressure, curl)

    @property
    def axis(self) -> Array:
        """Unit vector from apex to base."""
        return np.asarray((self.base - self.apex) / np.linalg.norm(self.base - self.apex), np.float64)

    def pressure_difference(self, pressure: ArrayLike) -> Array:
        """Base less apex `(*batch)`, Pa, of a pressure `(*batch, *shape)`, Pa."""
        probe = PROBE * min(self.domain.grid.spacing)
        upper, lower = self.base - probe * self.axis, self.apex + probe * self.axis
        return pressure_difference(pressure, self.mask, self.domain.grid, upper, lower, probe)

    def _open_orifices(self, wall: geometry.WallPoints) -> dict[str, tuple[float, OpeningFlow]]:
        """Inlet and outlet where they are open, and the sign of their valve's own direction."""
        domain, found = self.domain, {}
        there = [int(label) for label in np.unique(wall.region[wall.region > 0])]
        passing = [label for label in there if domain.is_open(label, self.time)]
        for name, region, sign in (("flow_inlet", domain.inlet, 1.0), ("flow_outlet", domain.outlet, -1.0)):
            if region in passing:
                others = [label for label in passing if label != region]
                found[name] = (sign, OpeningFlow(domain.grid, self.mask, wall, region, others))
        return found


def _frames_of(velocity: NDArray[np.floating], frames: Sequence[int]) -> Array:
    """Some frames as `(frames, *batch, D, *shape)`, what is not finite as 0."""
    part = slice(frames[0], frames[-1] + 1)
    shape = np.shape(velocity)
    chosen = velocity[:, part] if len(shape) == 6 else velocity[part]
    array = np.nan_to_num(np.asarray(chosen, np.float64), posinf=0.0, neginf=0.0)
    return np.moveaxis(array, 1, 0) if len(shape) == 6 else array
