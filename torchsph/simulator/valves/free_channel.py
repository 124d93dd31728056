"""The free part of the channel behind an outlet, where only the flux is prescribed."""

from __future__ import annotations

import torch
from torch import Tensor

from ..state.clock import Clock
from .cavity_volume import CavityVolume
from .flux_split import fluxes, takers
from .openings import Openings


def free_length(
    openings: Openings, volume: CavityVolume, run_out: float, number: int, clock: Clock, members: int
) -> float | Tensor:
    """Length of the free channel before the buffer of an opening: 0 where fluid enters in the present interval.

    One for all members, or (members,) where members may differ in the sense of the flow: openings that share what they
    pass, and given fluxes that each member has its own factor for.

    Args:
        openings: of the scene's valves.
        volume: of the cavity.
        run_out: the length behind an outlet, internal.
        number: of the opening.
        clock: the present interval.
        members: of the run.
    """
    if not run_out or number in openings.given:
        return 0.0
    given = any(openings.valve(other).flux is not None for other in range(len(openings.all)))
    each = openings.valve(number).flux is None and len(takers(openings, openings.active(clock))) > 1
    each = each or (given and isinstance(clock.valve_strength, Tensor))
    inflow = torch.full((members if each else 1,), volume.rate_at(clock.middle), dtype=volume.dtype)
    through = fluxes(openings, clock, inflow.to(volume.device), time=clock.middle)[number]
    if each:
        return torch.where(through < 0.0, run_out, 0.0).to(through)
    return run_out if float(through) < 0.0 else 0.0
