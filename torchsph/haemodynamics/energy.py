"""Energy of a flow: what is stored, and what viscosity turns into heat.

| function | formula | unit |
|---|---|---|
| `kinetic_energy_density` | rho / 2 abs(u)^2 | J/m^3 |
| `kinetic_energy` | integral of it over the blood | J |
| `dissipation` | Phi = 2 mu S : S, S = (G + G') / 2 (Batchelor 1967, eq. 3.4.5 for div u = 0) | W/m^3 |
| `energy_loss` | integral of it over the blood | W (W/m in a plane) |

Integrals over the blood count the nodes of the mask with the volume of a cell each; `volume` scales the sum to the
volume that the wall encloses, where it is known: the mask's own differs from it by the cells that the wall cuts.

**Means hide energy.** The velocity of an analysis is the mean of what it may be, and a quadratic quantity of a mean is
too small: E[abs(u)^2] = abs(E[u])^2 + trace of the variance. `kinetic_energy` takes that variance as `sigma`. For the
dissipation the variance of the *gradient* is wanted. With errors alike in all directions, correlated as
exp(-r^2 / (2 L^2)), every derivative of a component has the variance sigma^2 / L^2 (Adler 1981);
`dissipation` takes `sigma` together with that `correlation_length` L. Members need neither: compute on every member.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .vorticity import tensor_axes

__all__ = ["dissipation", "energy_loss", "integral", "kinetic_energy", "kinetic_energy_density"]

Array = NDArray[np.float64]


def kinetic_energy_density(velocity: ArrayLike, mask: ArrayLike, rho: float, sigma: ArrayLike | None = None) -> Array:
    """Kinetic energy per volume, J/m^3: `(*batch, *shape)`, 0 outside the mask.

    Args:
        velocity: `(*batch, D, *shape)`, m/s.
        mask: `(*shape)`, or with the batch axes.
        rho: density, kg/m^3.
        sigma: standard deviation of each component, like `velocity`, m/s; its variance is added.
    """
    inside = np.asarray(mask, bool)
    axis = -1 - _dimension(velocity, inside.ndim)
    square = (np.asarray(velocity, np.float64) ** 2).sum(axis)
    if sigma is not None:
        square = square + (np.asarray(sigma, np.float64) ** 2).sum(axis)
    return np.where(inside, 0.5 * rho * square, 0.0)


def kinetic_energy(
    velocity: ArrayLike,
    mask: ArrayLike,
    cell_volume: float,
    rho: float,
    *,
    sigma: ArrayLike | None = None,
    volume: float | None = None,
) -> Array:
    """Kinetic energy of the blood, J: `(*batch)`.

    Args:
        velocity: `(*batch, D, *shape)`, m/s.
        mask: `(*shape)`.
        cell_volume: m^3 (in a plane m^2, and the result is J/m).
        rho: density, kg/m^3.
        sigma: standard deviation of each component, m/s: see `kinetic_energy_density`.
        volume: that the wall encloses, m^3; `None`: that of the mask.
    """
    return integral(kinetic_energy_density(velocity, mask, rho, sigma), mask, cell_volume, volume)


def dissipation(
    gradient: ArrayLike,
    mask: ArrayLike,
    mu: float,
    sigma: ArrayLike | None = None,
    correlation_length: float | None = None,
) -> Array:
    """Viscous dissipation per volume, W/m^3: `(*batch, *shape)`, 0 outside the mask.

    Args:
        gradient: `(*batch, D, D, *shape)`, 1/s.
        mask: `(*shape)`, or with the batch axes.
        mu: dynamic viscosity, Pa s.
        sigma: standard deviation of each component of the velocity `(*batch, D, *shape)`, m/s.
        correlation_length: L of the velocity's error, m, wanted with `sigma`.

    Raises:
        ValueError: one of `sigma` and `correlation_length` is given without the other.
    """
    if (sigma is None) != (correlation_length is None):
        raise ValueError("dissipation: sigma and correlation_length are wanted together, or neither")
    tensor, dimension = tensor_axes(gradient)
    strain = 0.5 * (tensor + np.swapaxes(tensor, -2, -1))
    square = 2 * (strain**2).sum((-2, -1))
    if sigma is not None and correlation_length is not None:
        # 2 S:S = sum_ij (G_ij^2 + G_ij G_ji); of independent components only the diagonal of the second is correlated
        variance = (np.asarray(sigma, np.float64) ** 2).sum(-1 - dimension) / correlation_length**2
        square = square + (dimension + 1) * variance
    return np.where(np.asarray(mask, bool), mu * square, 0.0)


def energy_loss(
    gradient: ArrayLike, mask: ArrayLike, cell_volume: float, mu: float, *, volume: float | None = None
) -> Array:
    """Power that viscosity takes from the flow, W: `(*batch)`.

    Args:
        gradient: `(*batch, D, D, *shape)`, 1/s.
        mask: `(*shape)`.
        cell_volume: m^3.
        mu: dynamic viscosity, Pa s.
        volume: that the wall encloses, m^3; `None`: that of the mask.
    """
    return integral(dissipation(gradient, mask, mu), mask, cell_volume, volume)


def integral(density: ArrayLike, mask: ArrayLike, cell_volume: float, volume: float | None = None) -> Array:
    """Integral of a density `(*batch, *shape)` over the mask `(*shape)`: `(*batch)`.

    Raises:
        ValueError: the mask has no node.
    """
    inside = np.asarray(mask, bool)
    nodes = int(inside.sum())
    if nodes == 0:
        raise ValueError("integral: the mask has no node, so that there is no blood to integrate over")
    total = np.asarray(density, np.float64)[..., inside].sum(-1)
    return total * (cell_volume if volume is None else volume / nodes)


def _dimension(velocity: ArrayLike, axes: int) -> int:
    """D of a velocity `(*batch, D, *shape)`; where a batch of three planes looks like a volume, that of the mask."""
    shape = np.shape(velocity)
    fitting = [one for one in (3, 2) if len(shape) > one and shape[-1 - one] == one]
    if fitting:
        return axes if axes in fitting else fitting[0]
    raise ValueError(f"a velocity must be (..., D, *shape) with D of 2 or 3, not {shape}")
