"""Members that break down: how that is seen, and what becomes of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .schemes.scheme import Scheme
from .state.particles import Particles
from .state.record import Record


class NumericalFailure(RuntimeError):
    """Every member of a run has failed; the record says how far each came."""


def broken_members(particles: Particles, scheme: Scheme, record: Record) -> Tensor:
    """Members (members,) bool with a particle that is not finite, or denser or thinner than a rollback allows.

    Notes the densities on the way; in an incompressible fluid they do not change.
    """
    p = particles
    broken = torch.zeros_like(record.failed)
    # a sum is finite only if all its terms are; which they are is looked up only where it is not
    if not math.isfinite(float(p.position.sum() + p.velocity.sum() + p.deviation.sum())):
        finite = torch.isfinite(p.position).all(1) & torch.isfinite(p.velocity).all(1) & torch.isfinite(p.deviation)
        broken = p.per_member((~finite).to(torch.int64), "sum") > 0
    if scheme.compressible:
        lowest, highest = p.per_member(p.deviation, "amin"), p.per_member(p.deviation, "amax")
        record.note_density(lowest, highest)
        if scheme.rollback is not None:
            least, most = scheme.rollback.density
            broken |= (1.0 + lowest < least) | (1.0 + highest > most)
    return broken


def freeze_members(broken: Tensor, record: Record, time: float) -> None:
    """Note members ``broken`` (members,) bool as failed for good, at about ``time`` (s).

    Raises:
        NumericalFailure: none is left.
    """
    record.failed |= broken
    if bool(record.failed.all()):
        raise NumericalFailure(
            f"all {record.members} members have failed (not finite, too fast for any step, or beyond the density that "
            f"a rollback allows) after {record.steps.tolist()} steps at about {time:.6g} s, at a largest Mach "
            f"number of {float(record.largest_mach.max()):.2f}; look at the velocity and the walls around that "
            "time; in Python, lower the scheme's courant or raise its sound_speed"
        )


def without_lost(particles: Particles, record: Record, time: float) -> Particles:
    """Particles with finite positions; members whose are not are frozen, so that the others can be searched."""
    lost = ~torch.isfinite(particles.position).all(1)
    if not bool(lost.any()):
        return particles
    freeze_members(particles.per_member(lost.to(torch.int64), "sum") > 0, record, time)
    place = torch.where(lost[:, None], torch.zeros_like(particles.position), particles.position)
    return particles.changed(position=place)
