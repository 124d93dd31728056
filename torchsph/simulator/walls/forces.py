"""Walls as look-up fields: distance, normal, wall velocity and the kernel's share in the fluid, on a grid.

A particle pays one interpolated look-up for all walls.  The fields stand at moments of the wall's motion and are linear
in time between them (the thesis's two textures, section 3.1.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsph.pairs.vectors import square_length

from ..schemes.wall_models import PotentialWall

# the velocity gradient at the wall is taken over at least this distance (spacings): closer particles would be braked
# faster than the viscous time step resolves. Many stand within 0.3 of the wall: 0.3 here lets a pipe flow slip by 0.5 %
SMALLEST_FRICTION_DISTANCE = 0.15

# a particle whose kernel lies almost wholly behind walls would divide by nothing
SMALLEST_SHARE = 0.1


@dataclass(frozen=True)
class WallSample:
    """The wall as particles see it, internal units.

    Attributes:
        distance: (N,), positive in the fluid. normal: (N, D), unit, into the fluid.
        velocity: (N, D) of the nearest wall point.
        share: (N,) integral of the kernel over the fluid domain, or None (wall model without it).
        share_gradient: (N, D) its gradient, which points into the fluid; None likewise.
        swept: (N,) integral of the kernel times the wall's normal velocity (inwards) over its surface, or None: the
            nearest point's velocity stands for all of the wall.
        rows: (N, C) all of it side by side, for compiled code (``wall_pass``), or None.
    """

    distance: Tensor
    normal: Tensor
    velocity: Tensor
    share: Tensor | None = None
    share_gradient: Tensor | None = None
    swept: Tensor | None = None
    rows: Tensor | None = None


def _depth(model: PotentialWall, wall: WallSample) -> Tensor:
    """s = 1 - d / reach, clipped to [0, 2]: how deep in the potential; the clip bounds the force beyond the wall."""
    return (1.0 - wall.distance / model.reach).clamp(0.0, 2.0)


def potential(model: PotentialWall, sound_speed: float | Tensor, wall: WallSample) -> Tensor:
    """U = stiffness c^2 s^2 / 2, (N,)."""
    return 0.5 * model.stiffness * sound_speed**2 * _depth(model, wall) ** 2


def potential_force(model: PotentialWall, sound_speed: float | Tensor, wall: WallSample) -> Tensor:
    """-grad U (3.1) as acceleration (N, D)."""
    strength = model.stiffness * sound_speed**2 / model.reach * _depth(model, wall)
    return strength[:, None] * wall.normal


def retardation(
    model: PotentialWall, sound_speed: float | Tensor, dt: Tensor, velocity: Tensor, wall: WallSample
) -> Tensor:
    """Velocity after the no-slip retardation (3.2 with the errata: relative to the wall, per time, not per step)."""
    relative = velocity - wall.velocity
    tangential = relative - (relative * wall.normal).sum(1, keepdim=True) * wall.normal
    rate = _depth(model, wall) * sound_speed / (model.relaxation * model.reach)
    return velocity + torch.expm1(-dt * rate)[:, None] * tangential


def wall_pressure_force(form: str, pressure: Tensor, deviation: Tensor, wall: WallSample) -> Tensor:
    """Pressure of the wall on particles (N, D): the pair formula of ``form`` integrated over the wall's surface.

    The wall carries the particle's own pressure and density (Ferrand et al. 2013 section 3.3).
    """
    own = {"symmetric": pressure, "sum": pressure, "switched": pressure.abs(), "difference": -pressure}[form]
    return ((pressure + own) / (1.0 + deviation))[:, None] * wall.share_gradient


def completed(
    divergence: Tensor, crowding: Tensor | None, velocity: Tensor, wall: WallSample | None
) -> tuple[Tensor, Tensor | None]:
    """Velocity divergence (N,) and crowding gradient (N, D) with the part of the kernel behind the wall added.

    Ferrand et al. 2013 eqs. 20-22 with the wall's velocity: the sums are divided by the share of the kernel inside the
    fluid, and the wall contributes its surface integral.
    """
    if wall is None or wall.share is None:
        return divergence, crowding
    if wall.swept is None:
        swept = ((wall.velocity - velocity) * wall.share_gradient).sum(1)
    else:
        swept = wall.swept - (velocity * wall.share_gradient).sum(1)
    divergence = (divergence - swept) / wall.share.clamp_min(SMALLEST_SHARE)
    return divergence, None if crowding is None else crowding - wall.share_gradient


def friction_rate(viscosity: float | Tensor, wall: WallSample) -> Tensor:
    """2 nu |grad share| / d (N,): by which laminar friction takes on a no-slip wall's velocity (see ``friction``)."""
    gap = wall.distance.clamp_min(SMALLEST_FRICTION_DISTANCE)
    return 2.0 * viscosity * square_length(wall.share_gradient).sqrt() / gap


def friction(viscosity: float | Tensor, velocity: Tensor, wall: WallSample) -> Tensor:
    """Laminar friction with a no-slip wall: 2 nu |grad share| (v_wall - v) / d (Ferrand et al. 2013 eq. 30)."""
    return friction_rate(viscosity, wall)[:, None] * (wall.velocity - velocity)
