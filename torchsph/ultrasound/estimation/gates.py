"""Which kernels are worth correlating: whole and finite ones with enough blood in them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..acquisition import decibel
from .estimates import Flag, bit
from .prepared import Prepared


def gates(
    images: Prepared,
    nodes: Tensor,
    *,
    min_samples: int,
    min_blood: float | None,
    min_snr: float | None,
    max_snr: float | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Power over noise (dB), share of power passed (dB) and the flags that need no correlation, each (P,).

    See :class:`SpeckleTracker` for the thresholds.

    Args:
        images: the packet, prepared.
        nodes: (P, 3), in the middle of the kernels.
        min_samples: nodes per axis that a kernel needs.
        min_blood: dB, least share of the power that passes the clutter filter, or ``None``.
        min_snr: dB, least power over noise, or ``None``.
        max_snr: dB, greatest power over noise, or ``None``.
    """
    covered = images.covered(nodes)
    count = covered.prod(1).clamp_min(1)
    passed = images.kernel_sums(images.power, nodes) / count
    before = images.kernel_sums(images.raw_power, nodes) / count
    share = decibel(passed / before.clamp_min(torch.finfo(before.dtype).tiny))
    flags = bit((covered[:, list(images.active)] < min_samples).any(1), Flag.SAMPLES)
    if images.spoilt is not None:
        flags |= bit(images.kernel_sums(images.spoilt, nodes) > 0, Flag.NOT_FINITE)
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
