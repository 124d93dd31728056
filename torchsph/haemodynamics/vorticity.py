"""Rotation of a flow, from its velocity gradient G_ij = du_i / dx_j.

| function | formula | unit |
|---|---|---|
| `vorticity` | omega = curl u | 1/s |
| `helicity_density` | u . omega | m/s^2 |
| `q_criterion` | Q = (abs(W)^2 - abs(S)^2) / 2, S and W the symmetric and antisymmetric part of G | 1/s^2 |
| `lambda2` | middle eigenvalue of S^2 + W^2 | 1/s^2 |
| `swirl` | det G - (tr G)^2 / 4 of a plane: the square of the angular speed at which paths turn | 1/s^2 |

Vortices are where Q > 0 (Hunt, Wray & Moin 1988), or lambda2 < 0 (Jeong & Hussain 1995): a local minimum of
pressure across two axes. In a plane flow lambda2 = -Q for a divergence of zero. In a plane that blood passes through
the divergence is not zero; there paths turn where the eigenvalues of G are a complex pair, so that `swirl` > 0 (Chong,
Perry & Cantwell 1990); without divergence that is Q.

All take `gradient` `(*batch, D, D, *shape)`, whatever it was computed by, and return fields over `(*batch, *shape)`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["helicity_density", "lambda2", "q_criterion", "swirl", "tensor_axes", "vorticity"]

Array = NDArray[np.float64]


def tensor_axes(gradient: ArrayLike) -> tuple[Array, int]:
    """The gradient `(*batch, D, D, *shape)` as `(*batch, *shape, D, D)`, and D.

    Raises:
        ValueError: no dimension D of 2 or 3 fits the axes.
    """
    array = np.asarray(gradient, np.float64)
    for dimension in (3, 2):
        axes = (-2 - dimension, -1 - dimension)
        if array.ndim >= dimension + 2 and all(array.shape[axis] == dimension for axis in axes):
            return np.moveaxis(array, axes, (-2, -1)), dimension
    raise ValueError(f"a velocity gradient must be (..., D, D, *shape) with D of 2 or 3, not {array.shape}")


def vorticity(gradient: ArrayLike) -> Array:
    """Curl of the velocity, 1/s: `(*batch, 3, *shape)`; in a plane the one component `(*batch, *shape)`.

    Args:
        gradient: `(*batch, D, D, *shape)`, 1/s.
    """
    tensor, dimension = tensor_axes(gradient)
    if dimension == 2:
        return tensor[..., 1, 0] - tensor[..., 0, 1]
    parts = [tensor[..., (i + 2) % 3, (i + 1) % 3] - tensor[..., (i + 1) % 3, (i + 2) % 3] for i in range(3)]
    return np.stack(parts, axis=-4)


def helicity_density(velocity: ArrayLike, curl: ArrayLike) -> Array:
    """u . omega, m/s^2, in space (Moffatt 1969): `(*batch, nz, ny, nx)`.

    Args:
        velocity: `(*batch, 3, *shape)`, m/s.
        curl: vorticity `(*batch, 3, *shape)`, 1/s.
    """
    return (np.asarray(velocity, np.float64) * np.asarray(curl, np.float64)).sum(-4)


def q_criterion(gradient: ArrayLike) -> Array:
    """Q of Hunt, Wray & Moin (1988), 1/s^2: half the excess of rotation over strain; `gradient` as above."""
    tensor, _ = tensor_axes(gradient)
    strain, spin = _parts(tensor)
    return 0.5 * ((spin**2).sum((-2, -1)) - (strain**2).sum((-2, -1)))


def lambda2(gradient: ArrayLike) -> Array:
    """Middle eigenvalue of S^2 + W^2, 1/s^2 (Jeong & Hussain 1995); negative in a vortex; `gradient` as above.

    In a plane S^2 + W^2 has a third eigenvalue of 0 across it, and the middle one counts all the same.
    """
    tensor, dimension = tensor_axes(gradient)
    strain, spin = _parts(tensor)
    both = strain @ strain + spin @ spin
    values = np.asarray(np.linalg.eigvalsh(both), np.float64)
    if dimension == 2:
        values = np.sort(np.concatenate([values, np.zeros_like(values[..., :1])], axis=-1), axis=-1)
    return np.asarray(values[..., 1], np.float64)


def swirl(gradient: ArrayLike) -> Array:
    """Square of the imaginary part of the eigenvalues of a plane's gradient `(*batch, 2, 2, ny, nx)`, 1/s^2.

    Below 0 they are real, and no path turns.

    Raises:
        ValueError: the gradient is one in space.
    """
    tensor, dimension = tensor_axes(gradient)
    if dimension != 2:
        raise ValueError("swirl: the gradient must be that of a plane, (..., 2, 2, ny, nx)")
    across, along = tensor[..., 0, 0], tensor[..., 1, 1]
    return -tensor[..., 0, 1] * tensor[..., 1, 0] - 0.25 * (across - along) ** 2


def _parts(tensor: Array) -> tuple[Array, Array]:
    turned = np.swapaxes(tensor, -2, -1)
    return 0.5 * (tensor + turned), 0.5 * (tensor - turned)
