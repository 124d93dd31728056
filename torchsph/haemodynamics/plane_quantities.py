"""All scalars of a flow in a plane, per metre of depth where they are integrals.

What a plane holds of a flow in space is its two velocity components in the plane and their derivatives there. Of a
plane cut out of a flow (`cut`) that is enough for speed, vorticity out of the plane, circulation and vortices, for what
passes its openings, and for the wall's shear within the plane. The energy loss is that of the three strains in the
plane alone, and so at most the flow's own: shear along the normal is not seen. Where the flow is a plane flow all of
them are exact, and the pressure too.

The pressure of a cut plane is left out: u . grad u lacks w du/dz. From true velocities of a ventricle's three-chamber
plane its difference from base to apex is a third off (.29 and .32 of its root mean square, correlation .95 and .93,
against the CFD's between the same places and between base and apex in space; the formula in space .16 and .996). So are
forces (the same term), helicity (0 by definition), volumes and fractions of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .domain import DomainFrame, FieldQuantities
from .energy import energy_loss, integral, kinetic_energy
from .fields.acceleration import material_acceleration
from .vortices import PlaneCore, plane_cores
from .vorticity import swirl, vorticity
from .wall_shear import WallShear

__all__ = ["CUT_UNITS", "PLANE_UNITS", "PlaneQuantities"]

Array = NDArray[np.float64]

CUT_UNITS = {
    "area": "m2",
    "speed_rms": "m/s",
    "kinetic_energy": "J/m",
    "kinetic_energy_density": "J/m3",
    "energy_loss": "W/m",
    "vorticity_rms": "1/s",
    "circulation_positive": "m2/s",
    "circulation_negative": "m2/s",
    "vortex_positive": "m2/s",
    "vortex_positive_area": "m2",
    "vortex_positive_depth": "1",
    "vortex_negative": "m2/s",
    "vortex_negative_area": "m2",
    "vortex_negative_depth": "1",
    "wall_shear": "Pa",
    "flow_inlet": "m2/s",
    "flow_outlet": "m2/s",
}
"""Quantities per frame; positive turns from x to y. Flows are per depth, in the direction of their valve."""

PLANE_UNITS = CUT_UNITS | {"pressure_difference": "Pa"}
"""The same of a plane flow, through whose plane nothing passes."""


class PlaneQuantities(DomainFrame):
    """The quantities of one frame of a plane, for any number of fields; see `DomainFrame` for its arguments."""

    def of(self, velocity: ArrayLike, rate: ArrayLike | None, *, sigma: ArrayLike | None = None) -> FieldQuantities:
        """Every quantity of `PLANE_UNITS`, or of `CUT_UNITS`, `(*batch)`.

        Args:
            velocity: `(*batch, 2, *shape)`, m/s, finite.
            rate: du/dt like it, m/s^2; `None` for a steady flow.
            sigma: standard deviation of each component `(2, *shape)`, m/s, for the kinetic energy.
        """
        domain, mask, speed = self.domain, self.mask, np.asarray(velocity, np.float64)
        cell, area = domain.grid.cell_volume, self.volume
        gradient = self.walled.gradient(speed)
        curl = vorticity(gradient)
        energy = kinetic_energy(speed, mask, cell, domain.rho, sigma=sigma, volume=area)
        curves = {
            "area": np.broadcast_to(area, np.shape(energy)),
            "speed_rms": np.sqrt(2 * energy / (domain.rho * area)),
            "kinetic_energy": energy,
            "kinetic_energy_density": energy / area,
            "energy_loss": energy_loss(gradient, mask, cell, domain.mu, volume=area),
            "vorticity_rms": np.sqrt(integral(curl**2, mask, cell, 1.0)),
            "circulation_positive": integral(np.maximum(curl, 0), mask, cell, area),
            "circulation_negative": integral(np.minimum(curl, 0), mask, cell, area),
        }
        curves |= self._vortices(gradient, curl) | {"wall_shear": self._shear(speed)}
        passed = np.trace(gradient, axis1=-4, axis2=-3) if domain.cut else None
        curves |= self.flows(speed, passed)
        if domain.cut:
            return FieldQuantities(curves, None, curl)
        acceleration = material_acceleration(speed, self.free.gradient(speed), rate)
        pressure = self.pressure(acceleration, speed)
        return FieldQuantities(curves | {"pressure_difference": self.pressure_difference(pressure)}, pressure, curl)

    def _vortices(self, gradient: Array, curl: Array) -> dict[str, Array]:
        """Circulation, area and depth of the strongest vortex of either sense; without one 0, and no depth."""
        lead, shape = curl.shape[:-2], curl.shape[-2:]
        fields = zip(curl.reshape(-1, *shape), swirl(gradient).reshape(-1, *shape), strict=True)
        cores = [plane_cores(turn, (kind > 0) & self.mask, self.domain.grid) for turn, kind in fields]
        found = {}
        for place, name in enumerate(("vortex_positive", "vortex_negative")):
            values = np.array([self._numbers(pair[place]) for pair in cores]).reshape(*lead, 3)
            for part, ending in enumerate(("", "_area", "_depth")):
                found[name + ending] = values[..., part]
        return found

    def _numbers(self, core: PlaneCore | None) -> tuple[float, float, float]:
        if core is None:
            return 0.0, 0.0, float("nan")
        length = float(np.linalg.norm(self.base - self.apex))
        return core.circulation, core.area, float((self.base - core.centre) @ self.axis) / length

    def _shear(self, velocity: Array) -> Array:
        """Mean over the wall of the size of its shear stress within the plane, `(*batch)`, Pa."""
        fit, lead = WallShear(self.domain.grid, self.mask, self.wall), velocity.shape[:-3]
        fields = velocity.reshape(-1, *velocity.shape[-3:])
        return np.array([fit.mean_size(one, self.domain.mu) for one in fields]).reshape(lead)
