"""The error that all of an estimate shares: its amplitude, which each member has of its own for the whole beat.

Members' anomalies are random and small in scale, and average out in an integral over the blood. What instrument and
smoothing take from every part of the flow alike does not: it is as large in an energy as in a velocity. Nobody knows it
for the vortices, but for the flow that the walls alone drive it can be seen (`amplitude_error`). Members therefore
differ by a factor on all but that flow, of mean 1 and that deviation, the same for a member in all frames.
"""

from __future__ import annotations

import torch
from scipy.special import ndtri
from torch import Tensor

from ..measurement.wall_balance import WallBalance

__all__ = ["Amplitude"]


class Amplitude:
    """What members are off by in amplitude.

    Args:
        balance: of mass between the walls; None: nothing is known, and members have the amplitude of the estimate.
        deviation: of the factors, relative.
        members: N.
        seed: of which member has which factor.
    """

    def __init__(self, balance: WallBalance | None, deviation: float, members: int, seed: int = 0) -> None:
        self.balance = balance
        # the quantiles of a normal distribution: few members then have exactly its mean, and nearly its deviation
        places = (torch.randperm(members, generator=torch.Generator().manual_seed(seed)) + 0.5) / members
        factors = torch.from_numpy(ndtri(places.numpy())).float()
        self.off = deviation * factors / factors.std()

    def of_fields(self, field: Tensor, frame: int) -> Tensor:
        """(N, D, *shape), m/s: what is added to the members around an estimate (D, *shape) of a frame."""
        if self.balance is None:
            return torch.zeros(())
        rest = field - torch.from_numpy(self.balance.known(frame))
        return self._each(rest)

    def of_rates(self, rate: Tensor) -> Tensor:
        """(N, D, *shape), m/s^2, the same for du/dt (D, *shape), whose known part is not told apart."""
        return torch.zeros(()) if self.balance is None else self._each(rate)

    def _each(self, field: Tensor) -> Tensor:
        return self.off.to(field.dtype).reshape(-1, *[1] * field.ndim) * field
