"""Single-particle pieces of the weakly compressible scheme: equation of state, time-step limits, shifting."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsph.pairs.backends.reference import SINGULARITY
from torchsph.pairs.interface import Rates
from torchsph.pairs.moving_least_squares import solve_small
from torchsph.pairs.smoothing_kernels import SmoothingKernel
from torchsph.pairs.vectors import per_particle, square_length

from ..state.particles import Particles


def tait_pressure(deviation: Tensor, sound_speed: float | Tensor, gamma: float | Tensor) -> Tensor:
    """p / rho0 = c^2 / gamma ((1 + d)^gamma - 1) (2.25 without the background), (N,).

    gamma = 1 is the linear equation of state; expm1/log1p keep the digits of a small deviation d in float32.
    """
    if not isinstance(gamma, Tensor) and gamma == 1.0:
        return sound_speed**2 * deviation
    return sound_speed**2 / gamma * torch.expm1(gamma * torch.log1p(deviation))


def tait_deviation(pressure: Tensor, sound_speed: float | Tensor, gamma: float | Tensor) -> Tensor:
    """The deviation (N,) at which ``tait_pressure`` is ``pressure`` (N,)."""
    if not isinstance(gamma, Tensor) and gamma == 1.0:
        return pressure / sound_speed**2
    return torch.expm1(torch.log1p(gamma * pressure / sound_speed**2) / gamma)


def step_limits(
    speed: Tensor,
    acceleration: Tensor,
    smoothing_length: float | Tensor,
    sound_speed: float | Tensor,
    viscosity: float | Tensor,
    courant: float | Tensor,
) -> Tensor:
    """Acoustic, viscous and force limits (Morris et al. 1997 eqs. 30-32) of each member: (3, members), internal time.

    ``speed`` and ``acceleration`` (members,) are the largest of each member. With the usual Courant fraction of 0.35
    the force limit is close to the customary 0.25 sqrt(h / |a|).
    """
    h = smoothing_length
    acoustic = courant * h / (sound_speed + speed).clamp_min(torch.finfo(speed.dtype).tiny)
    nu = torch.as_tensor(viscosity, dtype=speed.dtype, device=speed.device).expand_as(speed)
    viscous = courant * h * h / (8.0 * nu).clamp_min(torch.finfo(speed.dtype).tiny)
    force = courant * torch.sqrt(0.5 * h / acceleration.clamp_min(torch.finfo(speed.dtype).tiny))
    return torch.stack([acoustic.expand_as(speed), viscous, force])


def shepard_deviation(sums: Rates) -> Tensor:
    """Density deviation (N,) after Shepard's filter (2.20)."""
    return sums.shepard_mass / sums.shepard_volume - 1.0


def mls_deviation(sums: Rates) -> Tensor:
    """Density deviation (N,) of moving least squares (Colagrossi & Landrini 2003 eqs. 12-14; Dilts 1999).

    Exact for a linear density; where the neighbours lie in a line or plane, Shepard's value.
    """
    tilt = -solve_small(sums.moment_second, sums.moment_first[:, :, None])[:, :, 0]
    volume = sums.shepard_volume + (tilt * sums.moment_first).sum(1)
    return (sums.shepard_mass + (tilt * sums.moment_mass).sum(1)) / volume - 1.0


def softened_share(kernel: SmoothingKernel, dimension: int) -> float:
    """Part of the viscosity that acts, because the pair term has r^2 / (r^2 + 0.01 h^2) against coinciding particles.

    The ratio of the term's second moments over a continuum with and without the softening (Espanol & Revenga 2003
    eq. 23 is the one without); 0.984 for Wendland C2 in a plane. Dividing the viscosity by it makes flows decay right.
    """
    r = torch.linspace(0.0, kernel.support, _QUADRATURE, dtype=torch.float64)[1:-1]
    weight = kernel.gradient_factor(r, 1.0, dimension) * r ** (dimension + 1)
    return float((weight * r**2 / (r**2 + SINGULARITY)).sum() / weight.sum())


def shifting_displacement(
    particles: Particles,
    concentration: Tensor,
    step: Tensor,
    smoothing_length: float | Tensor,
    strength: float | Tensor,
    largest: bool = False,
    surface: float | None = None,
) -> Tensor:
    """Displacement -A h |v| dt grad C that evens out the particles (Lind et al. 2012, speed-limited form), (N, D).

    A floor on the speed keeps a resting fluid from freezing in disorder; a cap of a tenth of a spacing keeps the
    shift below anything that the velocity would have to be corrected for. With ``largest`` the speed is the largest
    of the member (Sun et al. 2017 eq. 14), so that stagnation points are evened out as well. Particles with
    h |grad C| above ``surface`` lie at a free surface and stay: there the gradient points out of the fluid (0.74 on a
    plane surface for Wendland C2, 0.03 two spacings below).
    """
    speed = square_length(particles.velocity).sqrt().clamp_min(_SPEED_FLOOR)
    if largest:
        speed = particles.per_member(speed, "amax").index_select(0, particles.member)
    amount = per_particle(strength * smoothing_length, particles.member) * speed * per_particle(step, particles.member)
    shift = -amount[:, None] * concentration
    if surface is not None:
        steepness = per_particle(smoothing_length, particles.member) * square_length(concentration).sqrt()
        shift = shift * (steepness < surface)[:, None]
    length = square_length(shift).sqrt()
    return shift * (_SHIFT_CAP / length.clamp_min(_SHIFT_CAP))[:, None]


_QUADRATURE = 4001
_SPEED_FLOOR = 0.05
_SHIFT_CAP = 0.1
