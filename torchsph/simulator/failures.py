"""Members that break down: how that is seen, and what becomes of them."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from .schemes.scheme import Scheme
from .state.particles import Particles
from .state.record import Record


class NumericalFailure(RuntimeError):
    """Every member of a run has failed; the record says how far each came."""


# relative to that at rest: what is called weakly compressible departs from it by hundredths, and a run that has
# exploded by any power of ten, while all its numbers are finite
_DENSITIES = (0.0, 3.0)


def broken_members(particles: Particles, scheme: Scheme, record: Record) -> Tensor:
    """Members (members,) bool with a particle that is not finite, or of a density that no liquid or rollback allows.

    Notes the densities on the way; in an incompressible fluid they do not change.
    """
    p = particles
    broken = torch.zeros_like(record.failed)
    # a sum is finite only if all its terms are; which they are is looked up only where it is not
    if not math.isfinite(float((p.position.sum() + p.velocity.sum() + p.deviation.sum()).detach())):
        finite = torch.isfinite(p.position).all(1) & torch.isfinite(p.velocity).all(1) & torch.isfinite(p.deviation)
        broken = p.per_member((~finite).to(torch.int64), "sum") > 0
    if scheme.compressible:
        lowest, highest = p.per_member(p.deviation, "amin"), p.per_member(p.deviation, "amax")
        record.note_density(lowest, highest)
        least, most = _DENSITIES if scheme.rollback is None else scheme.rollback.density
        broken |= (1.0 + lowest < least) | (1.0 + highest > most)
    return broken


# relative departures of the particles' volume from the cavity's: told beyond the first, void beyond the second
_VOLUME_TOLD, _VOLUME_SPOILT = 0.03, 0.2
# a start that fills less of its cavity has a free surface, or is no fluid at all
_FILLED = 0.8
_BROKEN = "not finite, too fast for any step, or beyond the densities that a liquid, or a rollback, allows"


def check_volume(record: Record, filled: Tensor, time: float) -> None:
    """Hold the volume of particles against the cavity's; what is off is told, and ends a member where it spoils it.

    Args:
        record: of the run, in a scene with valves; its ``filling`` is that of ``time``.
        filled: (members,) the filling at the start.
        time: s.

    Raises:
        NumericalFailure: no member is left.
    """
    error = torch.where(filled >= _FILLED, (record.filling / filled - 1.0).abs(), torch.zeros_like(filled))
    error = torch.where(record.failed, torch.zeros_like(error), error.nan_to_num(0.0))
    told = bool((record.volume_error > _VOLUME_TOLD).any())
    record.volume_error = torch.maximum(record.volume_error, error)
    if bool((error > _VOLUME_TOLD).any()) and not told:
        warnings.warn(
            f"the particles' volume is {100 * float(error.max()):.0f} % off that of the walls around them at about "
            f"{time:.3g} s: more went through the valves, or less, than the walls' motion asks for; look at the valve "
            "times, or use finer particles or another preset",
            stacklevel=4,
        )
    freeze_members(
        error > _VOLUME_SPOILT, record, time, f"volume more than {100 * _VOLUME_SPOILT:.0f} % off that of the walls"
    )


def freeze_members(broken: Tensor, record: Record, time: float, reason: str = _BROKEN) -> None:
    """Note members ``broken`` (members,) bool as failed for good, at about ``time`` (s), for a ``reason`` in words.

    Raises:
        NumericalFailure: none is left.
    """
    record.failed |= broken
    if bool(record.failed.all()):
        raise NumericalFailure(
            f"all {record.members} members have failed ({reason}) after {record.steps.tolist()} steps at about "
            f"{time:.6g} s, at a largest Mach "
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
