"""What a tracker says of each point: a velocity, how sure it looks, and why it may not be believed."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import torch
from torch import Tensor


class Flag(IntFlag):
    """Why an estimate is not to be believed; several can be set."""

    NONE = 0
    EDGE = 1  # speed at or beyond the search range
    WEAK = 2  # too little blood power over noise or clutter
    SAMPLES = 4  # the image cuts the kernel to fewer samples than required
    FLAT = 8  # the correlation has no peak (constant image, no scatterers)
    NOT_FINITE = 16  # NaN or infinity in the kernel
    DECORRELATED = 32  # correlation below the threshold
    BRIGHT = 64  # more power than blood has: tissue that passed the clutter filter
    AMBIGUOUS = 128  # the peak does not tell which whole turn of the phase is the right one
    STOPPED = 256  # a velocity that the clutter filter does not let pass: residue, or a whole turn off one


def bit(condition: Tensor, flag: Flag) -> Tensor:
    """``flag`` where the condition holds, as int32."""
    return condition.to(torch.int32) * int(flag)


@dataclass(frozen=True, eq=False)
class Estimates:
    """What a tracker says of each of n points; components in the order x, y, z.

    Args:
        velocity: (n, D), m/s.
        correlation: (n,), of the accepted lag, in [0, 1].
        peak_ratio: (n,), highest peak of the search over the second.
        curvature: (n, D), 1/m^2, -(second derivative of log |rho|) along each axis.
        variance: (n, D), (m/s)^2 up to a constant, what correlation and curvature say of the precision;
            calibration makes a ``sigma`` of it.
        power: (n,), dB, share of the unfiltered power that passed the clutter filter.
        snr: (n,), dB, power over thermal noise after the filter; NaN if the noise is unknown.
        response: (n,), dB, of the clutter filter at the Doppler frequency of the velocity.
        shear: (n,), 1/s, size of the axial velocity's gradient; NaN if not looked for.
        bend: (n,), m/s, how far the axial velocity half a kernel further on is off a straight line; NaN if not
            looked for.
        lag: (n,), images between those compared.
        flags: (n,), :class:`Flag` bits, 0 = accepted.
    """

    velocity: Tensor
    correlation: Tensor
    peak_ratio: Tensor
    curvature: Tensor
    variance: Tensor
    power: Tensor
    snr: Tensor
    response: Tensor
    shear: Tensor
    bend: Tensor
    lag: Tensor
    flags: Tensor

    @property
    def accepted(self) -> Tensor:
        """Points (n,) bool without any flag."""
        return self.flags == 0

    @staticmethod
    def joined(parts: list[Estimates]) -> Estimates:
        """Estimates of several sets of points as one."""
        names = Estimates.__dataclass_fields__
        return Estimates(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})
