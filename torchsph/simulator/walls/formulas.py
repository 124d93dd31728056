"""Formulas of complete-kernel walls (Ferrand et al. 2013), in torch's operations; ``compiled`` is the fast way."""

from __future__ import annotations

from torch import Tensor

from torchsph.pairs.vectors import norm

from .interface import CompleteWallSample

# the velocity gradient at the wall is taken over at least this distance (spacings): closer particles would be braked
# faster than the viscous time step resolves. Many stand within 0.3 of the wall: 0.3 here lets a pipe flow slip by 0.5 %
SMALLEST_FRICTION_DISTANCE = 0.15

# a particle whose kernel lies almost wholly behind walls would divide by nothing
SMALLEST_COMPLETENESS = 0.1


def wall_pressure_force(form: str, pressure: Tensor, deviation: Tensor, wall: CompleteWallSample) -> Tensor:
    """Pressure of the wall on particles: the pair formula of ``form`` integrated over the wall's surface.

    The wall carries the particle's own pressure and density (Ferrand et al. 2013, sec. 3.3).

    Args:
        form: of the pressure force (``MomentumTerms.pressure``).
        pressure: (N,), p / rho0.
        deviation: (N,), of the density.
        wall: walls at the particles.

    Returns:
        (N, D), acceleration before the division by the completeness.
    """
    own = {"symmetric": pressure, "sum": pressure, "switched": pressure.abs(), "difference": -pressure}[form]
    return ((pressure + own) / (1.0 + deviation))[:, None] * wall.completeness_gradient


def completed(
    divergence: Tensor, gradient: Tensor | None, velocity: Tensor, wall: CompleteWallSample
) -> tuple[Tensor, Tensor | None]:
    """First-pass sums with the part of the kernel behind the wall (Ferrand et al. 2013, eqs. 20-22).

    The sums are divided by the completeness of the kernel, and the wall contributes its surface integral, with its
    velocity.

    Args:
        divergence: (N,), of the velocity, summed over pairs.
        gradient: (N, D), of the concentration, summed over pairs, or None.
        velocity: (N, D).
        wall: walls at the particles.

    Returns:
        Velocity divergence (N,) and the concentration's gradient (N, D), or None without it.
    """
    if wall.swept is None:
        swept = ((wall.velocity - velocity) * wall.completeness_gradient).sum(1)
    else:
        swept = wall.swept - (velocity * wall.completeness_gradient).sum(1)
    divergence = (divergence - swept) / wall.completeness.clamp_min(SMALLEST_COMPLETENESS)
    return divergence, None if gradient is None else gradient - wall.completeness_gradient


def friction_rate(viscosity: float | Tensor, wall: CompleteWallSample) -> Tensor:
    """2 nu |grad gamma| / d (N,): by which laminar friction takes on a no-slip wall's velocity (see ``friction``)."""
    gap = wall.distance.clamp_min(SMALLEST_FRICTION_DISTANCE)
    return 2.0 * viscosity * norm(wall.completeness_gradient) / gap


def friction(viscosity: float | Tensor, velocity: Tensor, wall: CompleteWallSample) -> Tensor:
    """Laminar friction with a no-slip wall: 2 nu |grad gamma| (v_wall - v) / d (Ferrand et al. 2013, eq. 30), (N, D).

    Args:
        viscosity: kinematic, internal, a number or (N,).
        velocity: (N, D), internal.
        wall: walls at the particles.
    """
    return friction_rate(viscosity, wall)[:, None] * (wall.velocity - velocity)
