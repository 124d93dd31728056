"""Which kernels are worth correlating: whole and finite ones with enough blood in them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .acquisition import decibel
from .correlation import gather
from .estimates import Flag, bit
from .prepared import Prepared


def gates(
    images: Prepared, corner: Tensor, *, min_samples: int, min_blood: float | None, min_snr: float | None,
    max_snr: float | None,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Power over noise (dB), share of power passed (dB) and the flags that need no correlation, each (P,).

    ``corner`` (P, 3): first nodes of the kernels. See :class:`SpeckleTracker` for the thresholds.
    """

    def kernel(field: Tensor) -> Tensor:
        return gather(field[..., None], corner, images.shape.size)

    inside, finite = kernel(images.inside), kernel(images.finite)
    count = inside.sum((1, 2, 3)).clamp_min(1)
    passed = kernel(images.power).sum((1, 2, 3)) / count
    before = kernel(images.raw_power).sum((1, 2, 3)) / count
    share = decibel(passed / before.clamp_min(torch.finfo(before.dtype).tiny))
    flags = bit((finite < inside).flatten(1).any(1), Flag.NOT_FINITE)
    for axis in images.active:
        others = [a + 1 for a in range(3) if a != axis]
        flags |= bit(inside.amax(others).sum(1) < min_samples, Flag.SAMPLES)
    weak = passed <= 0
    if min_blood is not None:
        weak |= share < min_blood
    snr = torch.full_like(share, math.nan)
    if images.noise:
        snr = decibel(passed / images.noise)
        if min_snr is not None:
            weak |= snr < min_snr
        if max_snr is not None:
            flags |= bit(snr > max_snr, Flag.BRIGHT)
    return snr, share, flags | bit(weak, Flag.WEAK)
