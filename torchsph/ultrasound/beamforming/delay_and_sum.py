"""Delay-and-sum: IQ images from the signals of an array's elements (Perrot et al. 2021)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from geometry import Grid

from ..acquisition import Beams, IQPhase, Packet
from ..phase import baseband
from .channel_data import ChannelData
from .demodulation import demodulated

TILE = 512  # pixels worked on at a time, which bounds memory


@dataclass(frozen=True)
class DelayAndSum:
    """Options of :func:`delay_and_sum`.

    Args:
        f_number: depth over the width of the receiving aperture; 0 = all elements.
        beams: of the packet; ``None`` = parallel along the last axis, as for waves that leave straight, and from the
            middle of the circle for a convex array.
        phase: convention of the packet.
    """

    f_number: float = 1.5
    beams: Beams | None = None
    phase: IQPhase = IQPhase.BASEBAND

    def __post_init__(self) -> None:
        if not (math.isfinite(self.f_number) and self.f_number >= 0):
            raise ValueError(f"f_number must be finite and >= 0, got {self.f_number!r}")


def delay_and_sum(data: ChannelData | Sequence[ChannelData], grid: Grid, options: DelayAndSum | None = None) -> Packet:
    """IQ images of the transmissions of a wave, or of several that are compounded coherently.

    A pixel p is the sum over the elements of IQ(t) exp(2 pi i f t) at the time t of the way to p and back, between
    samples linear. The wave is at p when the first of the elements' own waves is: that holds for plane and diverging
    waves, not behind a focus. Of several waves an image is the mean of theirs, before any envelope is taken (Montaldo
    et al. 2009); what moves between them is not made up for.

    Args:
        data: RF (which is demodulated first) or IQ, of one wave or of each.
        grid: of the image, in the elements' coordinates.
        options: aperture, beams and phase.

    Raises:
        ValueError: where grid and elements differ in dimension, waves in their images, or RF cannot be demodulated.
    """
    options = options or DelayAndSum()
    waves = [data] if isinstance(data, ChannelData) else list(data)
    if not waves:
        raise ValueError("data: there is no wave")
    for wave in waves[1:]:
        if wave.acquisition != waves[0].acquisition or len(wave.signals) != len(waves[0].signals):
            raise ValueError("data: waves that are compounded must have one acquisition and as many images each")
    iq = sum((_images(wave, grid, options.f_number) for wave in waves[1:]), _images(waves[0], grid, options.f_number))
    beams = options.beams or _beams(waves[0], grid.dimension)
    packet = Packet(iq / len(waves), grid, waves[0].acquisition, beams, phase=IQPhase.CARRIER)
    return baseband(packet) if options.phase is IQPhase.BASEBAND else packet


def _beams(data: ChannelData, dimension: int) -> Beams:
    """Parallel along the last axis, or from where the normals of a curved array meet."""
    straight = (0.0,) * (dimension - 1) + (1.0,)
    if data.normals is None or bool((data.normals - data.normals[0]).abs().max() < 1e-9):
        return Beams(straight)
    normals = data.normals.double()
    across = torch.eye(dimension, dtype=torch.float64) - normals[:, :, None] * normals[:, None, :]
    right = (across @ data.elements.double()[:, :, None]).sum(0)
    apex = torch.linalg.solve(across.sum(0), right)[:, 0]  # least distance from all lines
    return Beams(straight, tuple(apex.tolist()))


def _images(data: ChannelData, grid: Grid, f_number: float) -> Tensor:
    """Images (T, *shape) of a wave, with the carrier."""
    if data.elements.shape[1] != grid.dimension:
        raise ValueError(f"elements are {data.elements.shape[1]}-D, the grid {grid.dimension}-D")
    data = demodulated(data)
    pixels, images = grid.nodes().double(), len(data.signals)
    samples = data.signals.permute(2, 1, 0).reshape(-1, images)  # element by element, so that a pixel reads rows
    tiles = [_summed(data, samples, tile.to(samples.device), f_number) for tile in pixels.split(TILE)]
    return torch.cat(tiles).T.reshape(images, *grid.shape).contiguous()


def _summed(data: ChannelData, samples: Tensor, pixels: Tensor, f_number: float) -> Tensor:
    """Values (P, T) of a tile of pixels.

    Args:
        data: IQ.
        samples: (elements * samples, T), the same by rows.
        pixels: (P, D), m, float64.
        f_number: depth over the width of the receiving aperture; 0 = all elements.
    """
    elements, count = data.elements.to(pixels), data.signals.shape[1]
    offset = pixels[:, None] - elements
    back = offset.norm(dim=2)
    delays, sound_speed = data.delays.to(pixels), data.acquisition.sound_speed
    there = _arrival(back, delays, sound_speed, in_a_row=pixels.shape[1] == 2)
    time = there[:, None] + back / sound_speed
    place = (time - data.start) * data.sampling_rate
    before = place.floor().clamp(0, count - 2)
    used = (place >= 0) & (place <= count - 2)
    if f_number > 0:
        ahead, aside = _seen(data, offset, back)
        used &= aside <= ahead / (2 * f_number)
    turn = 2 * math.pi * data.acquisition.frequency * time
    carrier = torch.polar(used.to(turn), turn)
    row = before.long() + torch.arange(len(elements), device=pixels.device) * count
    share = place - before
    total = samples.new_zeros((len(pixels), samples.shape[1]))
    for step, weight in ((0, 1 - share), (1, share)):
        rows = samples[row + step]
        total += torch.einsum("pe,pet->pt", (weight * carrier).to(rows), rows)
    return total


def _seen(data: ChannelData, offset: Tensor, back: Tensor) -> tuple[Tensor, Tensor]:
    """How far pixels lie ahead of the elements and beside their axes, (P, elements) each, m.

    Args:
        data: with its normals.
        offset: (P, elements, D), m, from the elements.
        back: (P, elements), m, its length.
    """
    if data.normals is None:
        return offset[..., -1], offset[..., :-1].norm(dim=2)
    ahead = (offset * data.normals.to(offset)).sum(-1)
    return ahead, (back.square() - ahead.square()).clamp_min(0).sqrt()


def _arrival(back: Tensor, delays: Tensor, sound_speed: float, *, in_a_row: bool) -> Tensor:
    """When the transmitted wave is at pixels, (P,), s.

    Args:
        back: (P, elements), m, distances.
        delays: (elements,), s; NaN = silent.
        sound_speed: m/s.
        in_a_row: whether each element lies beside the next.
    """
    fires = torch.isfinite(delays)
    times = back[:, fires] / sound_speed + delays[fires]
    first, least = times.min(1)
    if not in_a_row or times.shape[1] < 3:
        return first
    # between the elements the front is that of the parabola through the three times around the first
    middle = least.clamp(1, times.shape[1] - 2)
    before, at, after = (times.gather(1, (middle + step)[:, None])[:, 0] for step in (-1, 0, 1))
    slope, bend = 0.5 * (after - before), before - 2 * at + after
    vertex = at - slope.square() / (2 * bend).clamp_min(torch.finfo(bend.dtype).tiny)
    return torch.where((middle == least) & (slope.abs() <= bend), vertex, first)
