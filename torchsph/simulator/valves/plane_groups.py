"""Members whose openings stand in the same place are worked on together, the others apart.

An opening stays in one place for a while and then goes on to the next (``Openings.plane``). Members step each at its
own pace, so that for a moment some see the earlier place and some the later one: each the one of its own time, as it
would alone. Members that do not step are left as they are.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..state.clock import Clock
from ..state.particles import Particles
from .openings import Openings

# what is done to the particles of some members at their present times; True where they were renumbered
Work = Callable[[Particles, Clock], tuple[Particles, bool]]


def groups(openings: Openings, clock: Clock, members: int, stepping: Tensor | None = None) -> list[Tensor] | None:
    """Members (members,) bool that see the same planes, those with the earliest first; None: all see the same.

    Args:
        openings: of the scene's valves.
        clock: the present times.
        members: their number.
        stepping: (members,) bool, those that count; None: all.
    """
    place = openings.place_number(clock.times)
    everybody = place.new_ones((), dtype=torch.bool) if stepping is None else stepping.all()
    alike = place.new_ones((), dtype=torch.bool) if place.ndim == 0 or members == 1 else (place == place[0]).all()
    counted, alike = torch.stack([everybody, alike]).tolist()  # one look at the device for both
    if alike:
        return None if counted or stepping is None else [stepping]
    if counted or stepping is None:
        return [place == number for number in torch.unique(place)]
    return [(place == number) & stepping for number in torch.unique(place[stepping])]


def apart(
    openings: Openings, particles: Particles, clock: Clock, work: Work, stepping: Tensor | None = None
) -> tuple[Particles, bool]:
    """Particles of all members after work on those of each group; True where they were renumbered.

    Args:
        openings: of the scene's valves.
        particles: of all members.
        clock: their present times.
        work: what is done.
        stepping: (members,) bool, those to whom it is done; None: all.
    """
    found = groups(openings, clock, particles.members, stepping)
    if found is None:
        return work(particles, clock)
    rows, parts, renumbered = [], [], False
    left = torch.ones(particles.count, dtype=torch.bool, device=particles.member.device)
    for group in found:
        mine = group[particles.member]
        part, changed = work(particles.select(mine), clock.seen_by(group))
        rows.append(torch.nonzero(mine).squeeze(1))
        parts.append(part)
        renumbered |= changed
        left &= ~mine
    rows.append(torch.nonzero(left).squeeze(1))
    parts.append(particles.select(left))
    together = parts[0]
    for part in parts[1:]:
        together = together.joined(part)
    # where none came or went every particle goes back to its own row
    return (together if renumbered else together.select(torch.argsort(torch.cat(rows)))), renumbered


def measured_apart(
    openings: Openings, particles: Particles, clock: Clock, measure: Callable[[Particles, Clock], Tensor]
) -> Tensor:
    """What is measured of every member, (members,), from the particles of its group.

    Args:
        openings: of the scene's valves.
        particles: of all members.
        clock: their present times.
        measure: gives (members,) of particles of members that see the same planes.
    """
    found = groups(openings, clock, particles.members)
    if found is None:
        return measure(particles, clock)
    parts = [measure(particles.select(group[particles.member]), clock.seen_by(group)) for group in found]
    together = parts[0]
    for group, part in zip(found[1:], parts[1:], strict=True):
        together = torch.where(group, part, together)
    return together
