"""How the particles of a buffer, and of the free channel before it, move for a given flux."""

from __future__ import annotations

import torch
from torch import Tensor

from ..state.particles import Particles
from .openings import OpeningPlane

# the ratio of orifice area to the area that the buffer's particles stand for: beyond these bounds the buffer is being
# emptied or filled, and following it would let the flow run away
AREA_TRUST = (0.5, 2.0)


def volume_of_rows(particles: Particles, row: Tensor) -> Tensor:
    """Volume of the particles in ``row`` of each member, (members,); never 0."""
    mass = particles.mass[row]
    total = mass.new_zeros(particles.members).index_add(0, particles.member[row], mass)
    return torch.maximum(total, particles.mass.mean()) if particles.count else total.clamp_min(1.0)


def mean_near(particles: Particles, plane: OpeningPlane, values: Tensor) -> Tensor:
    """Mean of ``values`` (N,) over the fluid near an orifice, (members,)."""
    near = (particles.position - plane.centre).norm(dim=1) < plane.radius
    near &= particles.fluid
    total = particles.per_member(torch.where(near, values, torch.zeros_like(values)), "sum")
    return total / particles.per_member(near.to(values.dtype), "sum").clamp_min(1.0)


def scaled_profile(along: Tensor, owner: Tensor, speed: Tensor, *, flat: bool) -> Tensor:
    """Normal velocities (n,) scaled so that each member's mean is ``speed``; one speed for all where there is none.

    Args:
        along: (n,), present normal velocities.
        owner: (n,) int64, members of these particles.
        speed: (members,), wanted on the average.
        flat: whether the present profile is to be forgotten.
    """
    ones, forward = torch.ones_like(along), along * speed.sign()[owner]
    shape = forward.clamp_min(0.0)

    def total(values: Tensor) -> Tensor:
        return torch.zeros_like(speed).index_add(0, owner, values)

    count = total(ones).clamp_min(1.0)
    # what stood still, or flowed the other way until now, has no profile
    even = (total(forward) / count < 0.25 * speed.abs()) | flat
    scale = torch.where(even, speed, speed / (total(shape) / count).clamp_min(1e-5))
    return torch.where(even[owner], ones, shape) * scale[owner]


def with_channel_flux(
    particles: Particles, velocity: Tensor, free: Tensor, plane: OpeningPlane, speed: Tensor, length: float
) -> Tensor:
    """Velocities (N, D), in the free channel, ``free`` (N,) bool, with a mean that carries area times ``speed``.

    A pressure gradient along a straight channel speeds up all of it alike. The solver knows of none at the buffer,
    and would leave the channel, and with it the flow that ends there, several steps behind. Volume is what counts,
    not the mean speed: a jet that leaves the channel's walls is thinner and faster than the channel.

    Args:
        particles: the particles.
        velocity: (N, D), theirs.
        free: (N,) bool, those in the channel.
        plane: of the opening.
        speed: (members,), outward, of the flux through the opening over its area.
        length: of the channel.
    """
    row = torch.nonzero(free).squeeze(1)
    if not row.numel():
        return velocity
    owner, height = particles.member[row], plane.height(particles.position[row])
    # layers come and go at the ends of the channel: they count less there
    weight = particles.mass[row] * height.clamp(0.0, 1.0) * (length - height).clamp(0.0, 1.0)
    along = ((velocity[row] - plane.velocity) * plane.normal).sum(1)

    def total(values: Tensor) -> Tensor:
        return torch.zeros_like(speed).index_add(0, owner, values)

    contained = total(weight).clamp_min(1e-6)
    # an opening that narrows leaves behind it more than it holds; that flows no slower
    thinner = (plane.area * (length - 1.0) / contained).clamp(1.0, AREA_TRUST[1])
    missing = speed * thinner - total(weight * along) / contained
    return velocity.index_add(0, row, missing[owner][:, None] * plane.normal)
