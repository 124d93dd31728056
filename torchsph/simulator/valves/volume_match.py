"""The particles' volume beside the cavity's, and the mean density that would drift with what they differ by."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from torchsph.pairs.vectors import per_particle

from ..state.particles import Particles
from .openings import OpeningPlane

# what stands this far (spacings) on both sides of the plane counts in part as being inside: particles come in layers
_BLEND = 1.5


def volume_inside(particles: Particles, planes: Iterable[OpeningPlane]) -> Tensor:
    """Volume of the particles inside the cavity, (members,) float64, internal.

    A particle in an open orifice counts by the part that is inside, blended in over a spacing at the rim, so that the
    sum does not jump as it crosses.

    Args:
        particles: the particles.
        planes: of the open orifices.
    """
    part = particles.inside.to(particles.mass.dtype)
    for plane in planes:
        height = plane.height(particles.position)
        row = torch.nonzero(height.abs() < _BLEND).squeeze(1)
        over = plane.cover(particles.position[row])
        depth = 0.5 - 0.5 / _BLEND * height[row]
        part = part.index_put((row,), torch.lerp(part[row], depth * depth * (3.0 - 2.0 * depth), over))
    # in double: thousands of equal masses added in single precision drift by more than the difference
    return particles.per_member((part * particles.mass).double(), "sum")


def levelled(particles: Particles, planes: Iterable[OpeningPlane]) -> Particles:
    """Particles whose mean density deviation at the open orifices is 0.

    Where the speed of all that encloses a fluid is prescribed, the percents by which sums over neighbours miss the
    volume that is swept add up, to a pressure that is the same everywhere and tells nothing but feeds disorder.
    """
    near = torch.zeros_like(particles.inside)
    for plane in planes:
        near |= (particles.position - plane.centre).square().sum(1) < plane.radius**2
    weight = torch.where(particles.inside & near, particles.mass, torch.zeros_like(particles.mass))
    total = particles.per_member(weight, "sum").clamp_min(1.0)
    mean = particles.per_member(weight * particles.deviation, "sum") / total
    return particles.changed(deviation=particles.deviation - per_particle(mean, particles.member))
