"""Smoothing kernels W(r, h) with compact support, normalised in two and three dimensions.

Every kernel is written in the ratio q = r / h as  W = sigma_D / h^D * w(q)  and
dW/dr = sigma_D / h^(D+1) * w'(q).  Pair loops use the *gradient factor*  F = (dW/dr) / r, so that
grad_a W_ab = F * (x_a - x_b) needs no division by a vanishing distance.

``native/build.py`` numbers the kernels for C++ from here and reads this file by its path where there is no torch, which
is imported for the type checker alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from torch import Tensor

Profile: TypeAlias = "Callable[[Tensor], Tensor]"


@dataclass(frozen=True)
class SmoothingKernel:
    """A radial smoothing kernel.

    Attributes:
        name: the name that presets and outputs carry.
        support: radius of the support in smoothing lengths (W = 0 for r >= support * h).
        shape: w(q), dimensionless, for q inside the support.
        slope_over_q: w'(q) / q, finite at q = 0 except for the spiky kernel (see ``spiky``).
        normalisation: sigma_D for D = 2, 3.
        source: where the formula comes from.
    """

    name: str
    support: float
    shape: Profile
    slope_over_q: Profile
    normalisation: dict[int, float]
    source: str

    def value(self, distance: Tensor, smoothing_length: Tensor | float, dimension: int) -> Tensor:
        """W(r, h) in 1 / length^D; ``distance`` of any shape, same unit as ``smoothing_length``."""
        q = distance / smoothing_length
        inside = (q < self.support).to(distance.dtype)
        return self._sigma(dimension) / smoothing_length**dimension * self.shape(q) * inside

    def gradient_factor(self, distance: Tensor, smoothing_length: Tensor | float, dimension: int) -> Tensor:
        """F = (dW/dr) / r in 1 / length^(D+2); never positive; grad_a W_ab = F * (x_a - x_b)."""
        q = distance / smoothing_length
        inside = (q < self.support).to(distance.dtype)
        return self._sigma(dimension) / smoothing_length ** (dimension + 2) * self.slope_over_q(q) * inside

    def _sigma(self, dimension: int) -> float:
        if dimension not in self.normalisation:
            raise ValueError(f"kernel '{self.name}' has no normalisation in {dimension} dimensions; use 2 or 3")
        return self.normalisation[dimension]


def truncated_gaussian(truncation: float = 3.0) -> SmoothingKernel:
    """Gaussian of standard deviation h cut at ``truncation`` h (Grønli 2017, eq. 2.10, 2.11).

    The divisors are those of the errata: they restore the unit integral over the ball of radius truncation * h,
    1 - exp(-t^2/2) in the plane and erf(t/sqrt 2) - sqrt(2/pi) t exp(-t^2/2) in space.
    """
    if truncation <= 0:
        raise ValueError(f"truncation must be positive, got {truncation}")
    t = truncation
    tail = math.exp(-0.5 * t * t)
    kept = {2: 1.0 - tail, 3: math.erf(t / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * t * tail}
    sigma = {d: (2.0 * math.pi) ** (-0.5 * d) / kept[d] for d in (2, 3)}
    return SmoothingKernel(
        f"gaussian-{truncation:g}",
        t,
        lambda q: (-0.5 * q * q).exp(),
        lambda q: -(-0.5 * q * q).exp(),
        sigma,
        "Grønli 2017, eq. 2.10-2.11",
    )


def _cubic_shape(q: Tensor) -> Tensor:
    outer, inner = (2.0 - q).clamp_min(0.0), (1.0 - q).clamp_min(0.0)
    return 0.25 * outer**3 - inner**3


def _cubic_slope(q: Tensor) -> Tensor:
    # written without 1/q: inside q < 1 the slope is -3 q + 9/4 q^2
    inner = (q < 1.0).to(q.dtype)
    safe = q.clamp_min(0.5)
    return inner * (2.25 * q - 3.0) + (1.0 - inner) * (-0.75 * (2.0 - q).clamp_min(0.0) ** 2 / safe)


def _quintic_shape(q: Tensor) -> Tensor:
    a, b, c = (3.0 - q).clamp_min(0.0), (2.0 - q).clamp_min(0.0), (1.0 - q).clamp_min(0.0)
    return a**5 - 6.0 * b**5 + 15.0 * c**5


def _quintic_slope(q: Tensor) -> Tensor:
    a, b = (3.0 - q).clamp_min(0.0), (2.0 - q).clamp_min(0.0)
    inner = (q < 1.0).to(q.dtype)
    safe = q.clamp_min(0.5)
    # for q < 1: -5[(3-q)^4 - 6 (2-q)^4 + 15 (1-q)^4] = -120 q + 120 q^3 - 50 q^4, divided by q
    return inner * (-120.0 + 120.0 * q**2 - 50.0 * q**3) + (1.0 - inner) * (-5.0 * (a**4 - 6.0 * b**4) / safe)


def _wendland_t(q: Tensor) -> Tensor:
    return (1.0 - 0.5 * q).clamp_min(0.0)


def _spiky_slope(q: Tensor) -> Tensor:
    # dW/dr does not vanish at r = 0 (Grønli 2017, eq. 2.14); the floor only matters where there is no direction
    return -3.0 * (1.0 - q).clamp_min(0.0) ** 2 / q.clamp_min(1e-6)


_WENDLAND = "Wendland 1995; Dehnen & Aly 2012 table 1 (support 2 h)"
_PI = math.pi

KERNELS: dict[str, SmoothingKernel] = {
    "gaussian": truncated_gaussian(3.0),
    "cubic": SmoothingKernel(
        "cubic", 2.0, _cubic_shape, _cubic_slope, {2: 10 / (7 * _PI), 3: 1 / _PI}, "Monaghan 1992 (M4 spline)"
    ),
    "quintic": SmoothingKernel(
        "quintic",
        3.0,
        _quintic_shape,
        _quintic_slope,
        {2: 7 / (478 * _PI), 3: 1 / (120 * _PI)},
        "Morris, Fox & Zhu 1997 eq. 3 (M6 spline)",
    ),
    "wendland_c2": SmoothingKernel(
        "wendland_c2",
        2.0,
        lambda q: _wendland_t(q) ** 4 * (1 + 2 * q),
        lambda q: -5 * _wendland_t(q) ** 3,
        {2: 7 / (4 * _PI), 3: 21 / (16 * _PI)},
        _WENDLAND,
    ),
    "wendland_c4": SmoothingKernel(
        "wendland_c4",
        2.0,
        lambda q: _wendland_t(q) ** 6 * (1 + 3 * q + 35 / 12 * q**2),
        lambda q: -(_wendland_t(q) ** 5) * (14 / 3 + 35 / 3 * q),
        {2: 9 / (4 * _PI), 3: 495 / (256 * _PI)},
        _WENDLAND,
    ),
    "wendland_c6": SmoothingKernel(
        "wendland_c6",
        2.0,
        lambda q: _wendland_t(q) ** 8 * (1 + 4 * q + 6.25 * q**2 + 4 * q**3),
        lambda q: -(_wendland_t(q) ** 7) * (5.5 + 19.25 * q + 22 * q**2),
        {2: 78 / (28 * _PI), 3: 1365 / (512 * _PI)},
        _WENDLAND,
    ),
    "spiky": SmoothingKernel(
        "spiky",
        1.0,
        lambda q: (1 - q).clamp_min(0.0) ** 3,
        _spiky_slope,
        {2: 10 / _PI, 3: 15 / _PI},
        "Desbrun & Gascuel 1996; Grønli 2017, eq. 2.13-2.14",
    ),
}
# what compiled code calls them: Gaussians of every truncation are one family
NUMBERS = {name: number for number, name in enumerate(KERNELS)}


def viscosity_laplacian(distance: Tensor, smoothing_length: Tensor | float) -> Tensor:
    """Laplacian 45 / (pi h^6) (h - r) of the 3-D viscosity kernel; support h, never negative.

    Grønli 2017, eq. 2.15, 2.16. Only the Laplacian is offered: the kernel itself is singular at r = 0 (errata to
    eq. 2.13-2.16).
    """
    gap = (smoothing_length - distance).clamp_min(0.0)
    return 45.0 / (math.pi * smoothing_length**6) * gap


def kernel(name: str | SmoothingKernel) -> SmoothingKernel:
    """The kernel called ``name``; a ValueError lists the known names."""
    if isinstance(name, SmoothingKernel):
        return name
    if not isinstance(name, str) or name not in KERNELS:
        raise ValueError(f"unknown smoothing kernel {name!r:.60}; known: {', '.join(sorted(KERNELS))}")
    return KERNELS[name]
