"""Haemodynamic force: what the blood's momentum asks of its surroundings.

    F = rho integral of (du/dt + u . grad u) dV                                       [N]

(Domenichini & Pedrizzetti 2016; its opposite is what blood exerts on the walls and through the orifices). By the
transport theorem the same is d/dt of the momentum in the moving volume plus what leaves through the orifices.
`axial_components` gives the part along the long axis, positive from apex to base, and the size of the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .energy import integral

__all__ = ["axial_components", "haemodynamic_force"]

Array = NDArray[np.float64]


def haemodynamic_force(
    acceleration: ArrayLike, mask: ArrayLike, cell_volume: float, rho: float, *, volume: float | None = None
) -> Array:
    """Force on the blood, N: `(*batch, D)`.

    Args:
        acceleration: material acceleration `(*batch, D, *shape)`, m/s^2.
        mask: `(*shape)`.
        cell_volume: m^3.
        rho: density, kg/m^3.
        volume: that the wall encloses, m^3; `None`: that of the mask.
    """
    return rho * integral(acceleration, mask, cell_volume, volume)


def axial_components(force: ArrayLike, axis: ArrayLike) -> tuple[Array, Array]:
    """Component along `axis` `(D,)` and size of what is across it, both `(*batch)`, N, of `force` `(*batch, D)`."""
    direction = np.asarray(axis, np.float64)
    direction = direction / np.linalg.norm(direction)
    along = np.asarray(force, np.float64) @ direction
    across = np.asarray(force, np.float64) - along[..., None] * direction
    return along, np.linalg.norm(across, axis=-1)
