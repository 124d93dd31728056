"""The four parts of the blood of a beat (Eriksson et al. 2010, Bolger et al. 2007).

Tracers fill the ventricle at end-diastole. Carried backwards over the filling, each has either come in through the
inlet in this beat or was there before; carried forwards over the ejection, it either leaves through the outlet or
stays:

| | leaves | stays |
|---|---|---|
| came in | direct flow | retained inflow |
| was there | delayed ejection | residual volume |

The shares are volumes of end-diastolic blood over all of it. Every tracer stands for the same volume, so that the
shares of the inflow and of the outflow can be held against the stroke volume over the end-diastolic volume.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .moving_flow import MovingFlow, MovingWalls
from .tracers import Tracers, carry

__all__ = ["FlowComponents", "flow_components"]


class FlowComponents(NamedTuple):
    """Shares of the end-diastolic volume, which add up to 1, and the tracers both ways."""

    direct: float
    retained: float
    delayed: float
    residual: float
    forwards: Tracers
    backwards: Tracers


def flow_components(
    flow: MovingFlow,
    walls: MovingWalls,
    seeds: Tensor,
    *,
    ejection: tuple[float, float],
    filling: tuple[float, float],
    inlet: int = 1,
    outlet: int = 2,
    courant: float = 1.0,
) -> FlowComponents:
    """The four components of the blood at `seeds`.

    Args:
        flow: the velocities.
        walls: walls, orifices and valve times.
        seeds: `(n, D)`, m, evenly in the blood at end-diastole (`seed_blood`).
        ejection: from end-diastole to end-systole, s.
        filling: from end-systole to the end-diastole that `seeds` are taken for, s. In a recording that begins with the
            ejection this is the filling after it: the wall is back where it was, and the beat is taken to repeat.
        inlet: region of the inlet.
        outlet: region of the outlet.
        courant: see `carry`.

    Raises:
        ValueError: there are no seeds, or an interval runs backwards.
    """
    if len(seeds) == 0:
        raise ValueError("flow_components: there are no seeds")
    if not (ejection[1] > ejection[0] and filling[1] > filling[0]):
        raise ValueError(f"flow_components: ejection {ejection} and filling {filling} must each run forwards, s")
    forwards = carry(flow, seeds, *ejection, walls=walls, courant=courant)
    backwards = carry(flow, seeds, filling[1], filling[0], walls=walls, courant=courant)
    came, leaves = backwards.left_through == inlet, forwards.left_through == outlet
    direct, retained, delayed, residual = (
        float(part.to(torch.float64).mean())
        for part in (came & leaves, came & ~leaves, ~came & leaves, ~came & ~leaves)
    )
    return FlowComponents(direct, retained, delayed, residual, forwards, backwards)
