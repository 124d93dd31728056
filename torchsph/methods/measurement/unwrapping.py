"""Measurements that wrap: which branch each number belongs to, by its neighbours and by a forecast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.ndimage import binary_erosion
from torch import Tensor

import geometry
from geometry.arguments import checked
from torchsph.assimilation import Observations, Reason

from .informative import carry_values

# a forecast tells where the next branch is less likely than this, beside the likeliest
_DOUBT = 0.05


@checked
def unwrapped(recording: geometry.Recording) -> geometry.Recording:
    """A measurement with the turns of its limit (/nyquist) taken back, frame by frame (``geometry.unwrap``).

    Nodes at the edge of the mask, most of which lie along walls, are taken to be the slow ones.
    The limit stays in the recording: each number is still known modulo twice this, and an ensemble decides again.

    Args:
        recording: the measurement; one without a limit is handed back as it is.

    Returns:
        The recording with each measured component as continuous from node to node as it can be.
    """
    if recording.nyquist is None:
        return recording
    kind, velocity = geometry.measurement_type(recording), recording.velocity.copy()
    for frame, known in enumerate(carry_values(recording)):
        edge = recording.mask[frame] & ~binary_erosion(recording.mask[frame])
        limits = kind.limits(frame)
        assert limits is not None
        along = np.broadcast_to(kind.directions(frame), (kind.parts, *velocity.shape[1:]))
        for direction, limit in zip(along, limits, strict=True):
            speed = (np.where(known, velocity[frame], 0) * direction).sum(0, dtype=np.float64)
            turned = geometry.unwrap(speed, known, float(limit), edge) - speed
            velocity[frame] += (np.where(known, turned, 0) * direction).astype(np.float32)
    return replace(recording, velocity=velocity)


def nearest_branch(observations: Observations, predicted: Tensor, limit: Tensor) -> Observations:
    """Observations moved by whole turns to within a limit of the mean of what members predict of them.

    With d the distance from the mean, L the limit and S the variance that d should have (the members' and the
    observation's), the next branch is less likely by the factor  exp(-2 L (L - |d|) / S).  Where that is no small
    number, the forecast alone cannot tell; where the observation's neighbours had put it on another branch then, it is
    not used.

    Args:
        observations: m of them, on the branches that their neighbours ask for (``unwrapped``).
        predicted: (N, m), m/s; NaN where a member has none.
        limit: (m,), m/s, infinite for observations that do not wrap.

    Returns:
        The observations; those in doubt have the reason AMBIGUOUS.
    """
    wide, value = predicted.double(), observations.value.double()
    mean, spread = wide.mean(0), wide.var(0)
    wraps = torch.isfinite(limit) & torch.isfinite(mean) & (observations.codes() == 0)
    turn = torch.where(wraps, 2 * limit, 1.0)
    turns = torch.where(wraps, ((mean - value) / turn).round(), 0.0)
    moved = value + turn * turns
    variance = spread + observations.variance.double()
    next_branch = torch.exp(-turn * (0.5 * turn - (moved - mean).abs()) / variance)
    doubt = (turns != 0) & (next_branch > _DOUBT)
    reason = torch.where(doubt, int(Reason.AMBIGUOUS), observations.codes().long()).to(torch.uint8)
    return replace(observations, value=moved, reason=reason)
