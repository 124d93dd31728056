"""All scalars of a flow over its frames, for one field or for many members side by side.

Frame by frame: what depends on the mask and the walls alone (derivative operators, pressure equations, orifices) is
made once and serves all members, whose fields are read a few frames at a time: a stack on disk is never held whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

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

__all__ = ["UNITS", "FlowDomain", "flow_quantities", "long_axis"]

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
    rows = [_frame(domain, velocity, n, sampler, deviations[n], order) for n in range(frames)]
    return {name: np.stack([row[name] for row in rows], axis=-1) for name in UNITS}


def _frame(
    domain: FlowDomain,
    velocity: NDArray[np.floating],
    number: int,
    sampler: geometry.WallSampler,
    sigma: Array | None,
    order: int,
) -> dict[str, Array]:
    t, mask, grid = float(domain.time[number]), domain.mask[number], domain.grid
    surface = domain.motion.surface(t)
    near = range(max(number - order, 0), min(number + order + 1, len(domain.time)))
    fields = _frames_of(velocity, near)
    speed = fields[number - near[0]]
    volume, cell = surface.volume, grid.cell_volume
    walled, free = Derivatives(grid, mask, WallSamples.at(sampler, t)), Derivatives(grid, mask)
    gradient = walled.gradient(speed)
    curl = vorticity(gradient)
    rate = time_derivative(
        fields, domain.mask[list(near)], domain.time[list(near)], number - near[0], order=order, events=domain.events
    )
    acceleration = material_acceleration(speed, free.gradient(speed), rate)
    slope = pressure_gradient(acceleration, free.laplacian(speed), domain.rho, domain.mu)
    base, apex = long_axis(surface)
    axis = (base - apex) / np.linalg.norm(base - apex)
    probe = PROBE * min(grid.spacing)
    pressure = PressureSolver(grid, mask).solve(slope)
    force = haemodynamic_force(acceleration, mask, cell, domain.rho, volume=volume)
    along, across = axial_components(force, axis)
    energy = kinetic_energy(speed, mask, cell, domain.rho, sigma=sigma, volume=volume)
    flows = _flows(domain, speed, mask, sampler.at(t), t)
    return {
        "volume": np.broadcast_to(volume, np.shape(energy)),
        "kinetic_energy": energy,
        "kinetic_energy_density": energy / volume,
        "energy_loss": energy_loss(gradient, mask, cell, domain.mu, volume=volume),
        "vorticity_rms": np.sqrt(integral((curl**2).sum(-4), mask, cell, 1.0)),
        "helicity": integral(helicity_density(speed, curl), mask, cell, 1.0),
        "force_axial": along,
        "force_across": across,
        "pressure_difference": pressure_difference(
            pressure, mask, grid, base - probe * axis, apex + probe * axis, probe
        ),
        **flows,
    }


def _frames_of(velocity: NDArray[np.floating], frames: Sequence[int]) -> Array:
    """Some frames as `(frames, *batch, D, *shape)`, what is not finite as 0."""
    part = slice(frames[0], frames[-1] + 1)
    shape = np.shape(velocity)
    chosen = velocity[:, part] if len(shape) == 6 else velocity[part]
    array = np.nan_to_num(np.asarray(chosen, np.float64), posinf=0.0, neginf=0.0)
    return np.moveaxis(array, 1, 0) if len(shape) == 6 else array


def _flows(
    domain: FlowDomain, velocity: Array, mask: NDArray[np.bool_], wall: geometry.WallPoints, t: float
) -> dict[str, Array]:
    """Flow through inlet and outlet, each in its valve's direction; 0 through a valve that is shut."""
    nothing = np.zeros(velocity.shape[: -1 - domain.grid.dimension])
    found = {}
    for name, region, sign in (("flow_inlet", domain.inlet, 1.0), ("flow_outlet", domain.outlet, -1.0)):
        there = domain.is_open(region, t) and bool((wall.region == region).any())
        found[name] = sign * OpeningFlow(domain.grid, mask, wall, region).rate(velocity) if there else nothing
    return found
