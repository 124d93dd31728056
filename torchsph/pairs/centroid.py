"""The thesis's "poor man's XSPH": velocities pulled towards the mean velocities of the cells around them."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from .cell_search import _key, _shifted, nearest_image, placed_cells
from .interface import PairState, Support, check_search
from .vectors import per_particle, square_length


def centroid_xsph(state: PairState, support: Support, cell: float, period: Tensor | None = None) -> Tensor:
    """sum over own and adjacent cells c of V_c (v_c - v_a) W(|x_a - X_c|), (N, D), any device.

    V_c is the volume and v_c the mass-weighted mean velocity of the particles in a cell, X_c its middle
    (Gronli 2017 section 5.2; the full form is ``RateTerms.xsph``). Costs 3^D evaluations a particle.

    Args:
        cell: edge of the cells; on a periodic axis it is widened so that whole cells fill the period. Cells
            beyond the adjacent ones are not seen: the support should not reach further than 1.5 cells.

    Raises:
        ValueError: ``cell`` is not positive, a position is not finite, or a period is under three cells.
    """
    check_search(state.position, cell, period)
    dimension = state.position.shape[1]
    if state.position.shape[0] == 0:
        return torch.zeros_like(state.velocity)
    index, cells, lower, width = placed_cells(state.position, cell, period)
    keys, own = torch.unique(_key(index, state.member, cells), return_inverse=True)
    count = keys.shape[0]
    place, member = index.new_empty((count, dimension)), state.member.new_empty(count)
    place[own], member[own] = index, state.member

    def total(values: Tensor) -> Tensor:
        return values.new_zeros((count, *values.shape[1:])).index_add(0, own, values)

    mass, volume = total(state.mass), total(state.volume)
    # a cell of weightless particles pulls nobody
    velocity = total(state.mass[:, None] * state.velocity) / mass.clamp_min(torch.finfo(mass.dtype).tiny)[:, None]
    length = per_particle(support.length, state.member)
    middle = lower + (index.to(lower.dtype) + 0.5) * width
    inside = nearest_image(state.position - middle, period)
    pull, weights = torch.zeros_like(state.velocity), torch.zeros_like(state.mass)
    for offset in itertools.product((-1, 0, 1), repeat=dimension):
        target, real = _shifted(place, offset, cells, period)
        wanted = _key(target, member, cells)
        at = torch.searchsorted(keys, wanted).clamp_max(count - 1)
        acting = volume[at] * (real & (keys[at] == wanted))
        gap = inside - torch.tensor(offset, dtype=width.dtype, device=width.device) * width
        weight = support.kernel.value(square_length(gap).sqrt(), length, dimension) * acting.index_select(0, own)
        pull = pull + weight[:, None] * velocity[at].index_select(0, own)
        weights = weights + weight
    return pull - weights[:, None] * state.velocity
