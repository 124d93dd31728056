"""What a scanner does to make a packet of images: frequencies, beams, and the IQ samples that result.

The ground on which the simulated scanner and the estimators meet: neither knows the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

import torch
from torch import Tensor

from geometry import Grid


@dataclass(frozen=True)
class Acquisition:
    """Timing and wave of an acquisition.

    Args:
        frequency: Hz, the centre frequency.
        sound_speed: m/s.
        prf: Hz, how often an image is taken.
        packet: images taken in a row for one velocity estimate.
    """

    frequency: float = 5e6
    sound_speed: float = 1540.0
    prf: float = 4e3
    packet: int = 16

    def __post_init__(self) -> None:
        for name in ("frequency", "sound_speed", "prf"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive and finite, got {value!r}")
        if isinstance(self.packet, bool) or not isinstance(self.packet, int) or self.packet < 1:
            raise ValueError(f"packet must be a whole number >= 1, got {self.packet!r}")

    @property
    def interval(self) -> float:
        """Time between images, s."""
        return 1.0 / self.prf

    @property
    def phase_per_metre(self) -> float:
        """Phase that an echo turns through per metre of axial motion, 4 pi f / c, rad/m."""
        return 4 * math.pi * self.frequency / self.sound_speed

    @property
    def aliasing_speed(self) -> float:
        """Axial speed that turns the echo's phase by pi between images, c PRF / (4 f), m/s."""
        return self.sound_speed * self.prf / (4 * self.frequency)


@dataclass(frozen=True)
class Beams:
    """Where the beams point: parallel along ``direction``, or fanning out from ``apex`` on both sides of it.

    Args:
        direction: (D,), in which sound leaves the probe; made a unit vector.
        apex: (D,), m, from which the beams fan out; ``None`` = parallel beams.
    """

    direction: tuple[float, ...] = (0.0, 0.0, 1.0)
    apex: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        length = math.hypot(*self.direction)
        if len(self.direction) not in (2, 3) or not (math.isfinite(length) and length > 0):
            raise ValueError(f"beam direction must be 2 or 3 numbers, not all zero, got {self.direction!r}")
        if self.apex is not None and len(self.apex) != len(self.direction):
            raise ValueError(f"apex {self.apex!r} and direction {self.direction!r} differ in dimension")
        object.__setattr__(self, "direction", tuple(float(part) / length for part in self.direction))

    @property
    def dimension(self) -> int:
        """Dimension D of the space that the beams scan, 2 or 3."""
        return len(self.direction)

    def across(self) -> tuple[tuple[float, ...], ...]:
        """D - 1 unit vectors at right angles to the direction and to each other."""
        frame = torch.cat([torch.tensor([self.direction]).double().T, torch.eye(self.dimension).double()], 1)
        return tuple(map(tuple, torch.linalg.qr(frame)[0].T[1:].tolist()))

    def depth(self, points: Tensor) -> Tensor:
        """One-way path (n,), m, from the probe to points (n, D), up to a constant for parallel beams."""
        if self.apex is None:
            return points @ points.new_tensor(self.direction)
        return (points - points.new_tensor(self.apex)).norm(dim=-1)

    def directions(self, points: Tensor) -> Tensor:
        """Unit vectors (n, D) along the beams through points (n, D)."""
        if self.apex is None:
            return points.new_tensor(self.direction).expand_as(points)
        away = points - points.new_tensor(self.apex)
        return away / away.norm(dim=-1, keepdim=True)


class IQPhase(Enum):
    """What the phase of IQ samples does along depth z, for echoes of a carrier f.

    In both, motion away from the probe turns the phase of a sample backwards, so that Doppler sees no difference;
    what compares samples at different depths, as speckle tracking does, must know which one it has.
    """

    BASEBAND = "baseband"
    """Demodulated at the depth of the sample: an echo from z carries exp(-i 4 pi f z / c) wherever it is sampled."""
    CARRIER = "carrier"
    """As delay-and-sum leaves it: the carrier exp(+i 4 pi f z / c) of the sample's own depth is still in."""


@dataclass(frozen=True, eq=False)
class Packet:
    """IQ samples of T images on a grid.

    Args:
        iq: (T, *shape), complex64 or complex128, the samples.
        grid: where the samples lie.
        acquisition: how they were taken.
        beams: along which beams.
        noise: power of the thermal noise per sample where it is known (scanners measure it with the
            transmitter off).
        phase: what the samples' phase does along depth; ``None`` = what the samples themselves say when they are
            first used, see :func:`baseband`.
    """

    iq: Tensor
    grid: Grid
    acquisition: Acquisition
    beams: Beams
    noise: float | None = None
    phase: IQPhase | None = None

    def __post_init__(self) -> None:
        if not self.iq.is_complex():
            raise ValueError(f"iq must be complex (IQ samples), got {self.iq.dtype}")
        if self.iq.dim() != len(self.grid.shape) + 1 or tuple(self.iq.shape[1:]) != self.grid.shape:
            raise ValueError(f"iq has shape {tuple(self.iq.shape)}, its grid says (T, {self.grid.shape})")
        if self.beams.dimension != self.grid.dimension:
            raise ValueError(f"beams are {self.beams.dimension}-D, the grid {self.grid.dimension}-D")

    def with_iq(self, iq: Tensor, *, noise: float | None = None, phase: IQPhase | None = None) -> Packet:
        """The same packet with other samples (filtered ones, say), of which noise and phase are stated anew."""
        return replace(self, iq=iq, noise=noise, phase=phase)


def decibel(ratio: Tensor) -> Tensor:
    """Power ratio in dB; zero power gives -inf."""
    return 10 * torch.log10(ratio)
