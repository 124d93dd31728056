"""Single-particle pieces of the schemes: equation of state, time-step limits, the viscous term's softening."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsph.pairs.backends.reference import SINGULARITY
from torchsph.pairs.smoothing_kernels import SmoothingKernel

# points of the quadrature over the kernel's radius
_QUADRATURE = 4001


def tait_pressure(deviation: Tensor, sound_speed: float | Tensor, gamma: float | Tensor) -> Tensor:
    """p / rho0 = c^2 / gamma ((1 + d)^gamma - 1) (N,): Grønli 2017, eq. 2.25, without the background.

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
    """Acoustic, viscous and force limits of the time step (Morris et al. 1997, eqs. 30-32).

    With the usual Courant fraction of 0.35 the force limit is close to the customary 0.25 sqrt(h / |a|).

    Args:
        speed: (members,), largest of each member, internal.
        acceleration: (members,), largest of each member, internal.
        smoothing_length: internal.
        sound_speed: internal; 0 in an incompressible fluid.
        viscosity: kinematic, internal.
        courant: fraction of each limit.

    Returns:
        (3, members), internal time.
    """
    h = smoothing_length
    acoustic = courant * h / (sound_speed + speed).clamp_min(torch.finfo(speed.dtype).tiny)
    nu = viscosity.to(speed).expand_as(speed) if isinstance(viscosity, Tensor) else torch.full_like(speed, viscosity)
    viscous = courant * h * h / (8.0 * nu).clamp_min(torch.finfo(speed.dtype).tiny)
    force = courant * torch.sqrt(0.5 * h / acceleration.clamp_min(torch.finfo(speed.dtype).tiny))
    return torch.stack([acoustic.expand_as(speed), viscous, force])


def softened_share(kernel: SmoothingKernel, dimension: int) -> float:
    """Part of the viscosity that acts, because the pair term has r^2 / (r^2 + 0.01 h^2) against coinciding particles.

    The ratio of the term's second moments over a continuum with and without the softening (Espanol & Revenga 2003,
    eq. 23 is the one without); 0.984 for Wendland C2 in a plane. Dividing the viscosity by it makes flows decay right.
    """
    r = torch.linspace(0.0, kernel.support, _QUADRATURE, dtype=torch.float64)[1:-1]
    weight = kernel.gradient_factor(r, 1.0, dimension) * r ** (dimension + 1)
    return float((weight * r**2 / (r**2 + SINGULARITY)).sum() / weight.sum())
