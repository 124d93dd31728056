"""The signals that the elements of an array receive, and arrays of elements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..acquisition import Acquisition


@dataclass(frozen=True, eq=False)
class ChannelData:
    """What the elements of an array receive of T transmissions of one wave.

    Args:
        signals: (T, samples, elements), real (RF) or complex (IQ, demodulated at the acquisition's frequency).
        elements: (elements, D), m; sound leaves them along the last axis.
        delays: (elements,), s, when each one transmits; NaN = it does not.
        sampling_rate: Hz.
        acquisition: how the images were taken.
        start: s, time of the first sample.
        bandwidth: of the pulse, as a part of its frequency; ``None`` = not known.
        normals: (elements, D), unit vectors in which the elements look; ``None`` = all along the last axis.
    """

    signals: Tensor
    elements: Tensor
    delays: Tensor
    sampling_rate: float
    acquisition: Acquisition
    start: float = 0.0
    bandwidth: float | None = None
    normals: Tensor | None = None

    def __post_init__(self) -> None:
        if self.signals.dim() != 3:
            raise ValueError(f"signals must be (T, samples, elements), got the shape {tuple(self.signals.shape)}")
        count = self.signals.shape[2]
        if self.elements.dim() != 2 or len(self.elements) != count or self.elements.shape[1] not in (2, 3):
            raise ValueError(
                f"elements must be ({count}, 2 or 3) for these signals, got the shape {tuple(self.elements.shape)}"
            )
        if self.delays.shape != (count,) or not bool(torch.isfinite(self.delays).any()):
            raise ValueError(f"delays must be {count} times, at least one of them finite")
        if not (math.isfinite(self.sampling_rate) and self.sampling_rate > 0):
            raise ValueError(f"sampling_rate must be positive and finite, got {self.sampling_rate!r}")
        if self.normals is not None and self.normals.shape != self.elements.shape:
            raise ValueError(f"normals must be as many vectors as elements, got the shape {tuple(self.normals.shape)}")
        if self.bandwidth is not None and not 0 < self.bandwidth < 2:
            raise ValueError(f"bandwidth must be a part of the frequency between 0 and 2, got {self.bandwidth!r}")


def linear_array(count: int, pitch: float) -> Tensor:
    """Places (count, 2), m, of the elements of a linear array around 0, along x.

    Args:
        count: of elements.
        pitch: m, between them.
    """
    x = (torch.arange(count, dtype=torch.float64) - 0.5 * (count - 1)) * pitch
    return torch.stack([x, torch.zeros_like(x)], 1)


def convex_array(count: int, pitch: float, radius: float) -> tuple[Tensor, Tensor]:
    """Places and normals, (count, 2) each, of the elements of a convex array, m.

    As in MUST and PyMUST: the outermost elements lie at z = 0, the others before them, and the pitch is the chord
    between neighbours (Garcia 2022).

    Args:
        count: of elements.
        pitch: m, between them.
        radius: m, of curvature.
    """
    if not (math.isfinite(radius) and radius > 0 and pitch < 2 * radius):
        raise ValueError(f"radius of a convex array must be positive and above half the pitch, got {radius!r}")
    step = 2 * math.asin(0.5 * pitch / radius)
    angle = (torch.arange(count, dtype=torch.float64) - 0.5 * (count - 1)) * step
    normals = torch.stack([angle.sin(), angle.cos()], 1)
    return radius * (normals - torch.stack([torch.zeros_like(angle), angle[-1].cos().expand_as(angle)], 1)), normals


def plane_wave_delays(elements: Tensor, direction: tuple[float, ...], sound_speed: float) -> Tensor:
    """When elements transmit, (E,), s from the first one on, so that a plane wave leaves along a direction.

    Args:
        elements: (E, D), m.
        direction: (D,), of the wave.
        sound_speed: m/s.
    """
    along = elements.new_tensor(direction)
    delays = elements @ (along / along.norm()) / sound_speed
    return delays - delays.min()


def diverging_wave_delays(elements: Tensor, source: tuple[float, ...], sound_speed: float) -> Tensor:
    """When elements transmit, (E,), s from the first one on, so that a wave diverges from a source behind them.

    Args:
        elements: (E, D), m.
        source: (D,), m, the virtual source.
        sound_speed: m/s.
    """
    delays = (elements - elements.new_tensor(source)).norm(dim=1) / sound_speed
    return delays - delays.min()
