"""How much memory a direct solve takes, and how much there is."""

import os
from math import prod

import torch

from regularize.rows.operators import System
from regularize.rows.ordering import order

WORTH_COUNTING = 1 << 28  # bytes: a smaller bound settles the question without looking at the rows
COPIES = {"cpu": 1, "cuda": 3}  # of the band: factored in place, or cut into dense blocks beside it


def factor_work(system: System) -> float:
    """Multiplications of a banded factorisation of the coefficients that ``system`` touches."""
    ordering = order(system)
    return len(ordering.nodes) * system.components * float((ordering.half_bandwidth + 1) * system.components) ** 2


def band_bytes(system: System) -> int:
    """Bytes that the factor of ``system`` takes; an upper bound where that is small anyway."""
    knots, c = system.knots, system.components
    sides = sorted(n + knots.degree for n in knots.cells)
    # coefficients that share a cell lie at most degree layers apart, along every axis
    reach = sum(knots.degree * prod(sides[:axis]) for axis in range(len(sides)))
    copies = COPIES.get(system.blocks[0].target.device.type, 1)
    bound = 8 * copies * prod(sides) * c * (reach + 1) * c
    if bound <= WORTH_COUNTING:
        return bound
    ordering = order(system)
    return 8 * copies * len(ordering.nodes) * c * (ordering.half_bandwidth + 1) * c


def device_memory(device: torch.device) -> int:
    """Bytes of memory: all of the machine's, or what is free on a GPU."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
