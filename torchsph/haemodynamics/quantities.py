"""All scalars of a flow over its frames, for one field or for many members side by side.

Frame by frame: what depends on the mask and the walls alone (derivative operators, pressure equations, orifices) is
made once and serves all members, whose fields are read a few frames at a time: a stack on disk is never held whole.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

import geometry

from .beat import BEAT_UNITS, CUT_BEAT_UNITS, PLANE_BEAT_UNITS, beat_numbers, plane_beat_numbers
from .domain import DomainFrame, FieldQuantities, FlowDomain
from .energy import energy_loss, integral, kinetic_energy
from .fields.acceleration import material_acceleration, time_derivative
from .force import axial_components, haemodynamic_force
from .plane_quantities import CUT_UNITS, PLANE_UNITS, PlaneQuantities
from .vorticity import helicity_density, vorticity

__all__ = ["UNITS", "Catalogue", "FrameQuantities", "catalogue", "flow_quantities"]

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


class FrameQuantities(DomainFrame):
    """The quantities of one frame, for any number of fields.

    Args:
        domain: masks, walls and fluid.
        number: of the frame.
        sampler: of the domain's walls, made once for all frames; `None`: one of its own.
    """

    def of(self, velocity: ArrayLike, rate: ArrayLike | None, *, sigma: ArrayLike | None = None) -> FieldQuantities:
        """Every quantity of `UNITS` `(*batch)`, and the relative pressure.

        Args:
            velocity: `(*batch, D, *shape)`, m/s, finite.
            rate: du/dt like it, m/s^2; `None` for a steady flow.
            sigma: standard deviation of each component `(D, *shape)`, m/s, for the kinetic energy.
        """
        domain, mask, speed = self.domain, self.mask, np.asarray(velocity, np.float64)
        cell, volume = domain.grid.cell_volume, self.volume
        gradient = self.walled.gradient(speed)
        curl = vorticity(gradient)
        acceleration = material_acceleration(speed, self.free.gradient(speed), rate)
        pressure = self.pressure(acceleration, speed)
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
        return FieldQuantities(curves | self.flows(speed), pressure, curl)


class Catalogue(NamedTuple):
    """What is read out of one kind of flow.

    Attributes:
        units: of its quantities per frame.
        beat_units: of its numbers of the beat.
        frame: computes the quantities of one frame.
        beat: makes the numbers of the beat of their curves.
    """

    units: Mapping[str, str]
    beat_units: Mapping[str, str]
    frame: Callable[[FlowDomain, int, geometry.WallSampler | None], FrameQuantities | PlaneQuantities]
    beat: Callable[[ArrayLike, Mapping[str, ArrayLike]], dict[str, Array]]


def catalogue(dimension: int = 3, cut: bool = False) -> Catalogue:
    """The quantities of a flow in space, of a plane flow, or of a plane cut out of a flow in space."""
    if dimension == 3:
        return Catalogue(UNITS, BEAT_UNITS, FrameQuantities, beat_numbers)
    if cut:
        return Catalogue(CUT_UNITS, CUT_BEAT_UNITS, PlaneQuantities, plane_beat_numbers)
    return Catalogue(PLANE_UNITS, PLANE_BEAT_UNITS, PlaneQuantities, plane_beat_numbers)


def flow_quantities(
    domain: FlowDomain, velocity: NDArray[np.floating], *, sigma: ArrayLike | None = None, order: int = 2
) -> dict[str, Array]:
    """Every quantity of the domain's catalogue over time: `(*batch, T)`.

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
    shape, frames, dimension = np.shape(velocity), len(domain.time), domain.grid.dimension
    whole = (frames, dimension, *domain.grid.shape)
    if shape[-2 - dimension :] != whole or len(shape) > dimension + 3:
        raise ValueError(
            f"flow_quantities: the velocity must be (T, D, *shape) = {whole} or a stack of such, not {shape}"
        )
    batched, kind = len(shape) == dimension + 3, catalogue(dimension, domain.cut)
    sampler = geometry.WallSampler(domain.motion, min(domain.grid.spacing))
    deviations = [None] * frames if sigma is None else list(np.nan_to_num(np.asarray(sigma, np.float64)))
    rows = []
    for n in range(frames):
        near = list(range(max(n - order, 0), min(n + order + 1, frames)))
        fields, place = _frames_of(velocity, near, batched), n - near[0]
        rate = time_derivative(fields, domain.mask[near], domain.time[near], place, order=order, events=domain.events)
        rows.append(kind.frame(domain, n, sampler).of(fields[place], rate, sigma=deviations[n])[0])
    return {name: np.stack([row[name] for row in rows], axis=-1) for name in kind.units}


def _frames_of(velocity: NDArray[np.floating], frames: Sequence[int], batched: bool) -> Array:
    """Some frames as `(frames, *batch, D, *shape)`, what is not finite as 0."""
    part = slice(frames[0], frames[-1] + 1)
    chosen = velocity[:, part] if batched else velocity[part]
    array = np.nan_to_num(np.asarray(chosen, np.float64), posinf=0.0, neginf=0.0)
    return np.moveaxis(array, 1, 0) if batched else array
