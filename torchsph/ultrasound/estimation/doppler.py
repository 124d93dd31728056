"""Doppler: the velocity along the beam from the phase between images, and full vectors from several beams.

The lag-one autocorrelation of Kasai et al. 1985. Speeds beyond
:attr:`Acquisition.aliasing_speed` wrap around, as on every scanner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..acquisition import Packet
from ..phase import baseband
from .box_sums import box_sum
from .clutter import ClutterFilter, FIRFilter


@dataclass(frozen=True)
class ColourDoppler:
    """Options of :func:`colour_doppler`, the autocorrelation over a window.

    Args:
        window: m, its side on every axis.
        clutter: filter over the packet; ``None`` = already filtered.
        min_snr: dB, least power over the packet's noise after the filter; ``None`` = no gate.
    """

    window: float = 1e-3
    clutter: ClutterFilter | None = field(default_factory=FIRFilter)
    min_snr: float | None = 3.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.window) and self.window > 0):
            raise ValueError(f"window must be positive and finite, got {self.window!r}")


@dataclass(frozen=True, eq=False)
class DopplerEstimates:
    """What Doppler says of each of n points.

    Args:
        speed: (n,), m/s, along the beam, positive away from the probe.
        sigma: (n,), m/s, its standard deviation.
        coherence: (n,), |R(1)| / R(0), in [0, 1].
        accepted: (n,), bool.
    """

    speed: Tensor
    sigma: Tensor
    coherence: Tensor
    accepted: Tensor


def colour_doppler(packet: Packet, points: Tensor, options: ColourDoppler) -> DopplerEstimates:
    """Axial velocities at the image nodes nearest to some points.

    With R(k) the sum of conj(I(t)) I(t + k) over images and window, speed = -arg R(1) c PRF / (4 pi f), and

        sigma^2 = (1 - coherence^2) / (2 N coherence^2) (c PRF / (4 pi f))^2

    with N pairs of images: the Cramer-Rao bound for one speckle per window, larger than the error if it holds
    several.

    Args:
        packet: IQ images.
        points: (n, D), m, inside the image.
        options: window, filter and gate.

    Raises:
        ValueError: where the clutter filter leaves fewer than two images, points lie outside, or the packet's phase
            fits no convention.
    """
    packet = baseband(packet)
    finite = torch.isfinite(torch.view_as_real(packet.iq)).all(-1).all(0)
    clean = torch.where(finite, packet.iq, 0)
    filtered = clean if options.clutter is None else options.clutter.apply(clean)
    if len(filtered) < 2:
        raise ValueError(f"Doppler needs two images after the clutter filter, {len(filtered)} are left")
    place = packet.grid.locate(points.double()).round().long().flip(-1).to(packet.iq.device)
    last = torch.tensor(packet.grid.shape, device=place.device) - 1
    if bool(((place < 0) | (place > last)).any()):
        raise ValueError("some Doppler points lie outside the image; select those inside its grid")
    first = (filtered[:-1].conj() * filtered[1:]).sum(0)
    power = 0.5 * (filtered[:-1].abs().square() + filtered[1:].abs().square()).sum(0)
    sums = torch.stack([first.real, first.imag, power, finite.to(power)])
    for number, step in enumerate(packet.grid.spacing):
        nodes = 2 * round(options.window / (2 * step)) + 1
        sums = box_sum(sums, nodes, sums.dim() - 1 - number)
    real, imaginary, power, count = (part[place.unbind(1)] for part in sums)
    coherence = (torch.hypot(real, imaginary) / power.clamp_min(torch.finfo(power.dtype).tiny)).clamp(0, 1)
    per_radian = packet.acquisition.prf / packet.acquisition.phase_per_metre
    pairs = len(filtered) - 1
    bound = (1 - coherence.square()).clamp_min(1e-6) / (2 * pairs * coherence.square().clamp_min(1e-6))
    accepted = (power > 0) & (count > 0)
    if packet.noise and options.min_snr is not None:
        gain = 1.0 if options.clutter is None else options.clutter.noise_gain(len(packet.iq))
        snr = 10 * torch.log10(power / (count * pairs).clamp_min(1) / (packet.noise * gain))
        accepted &= snr >= options.min_snr
    # a phase that is no better than random still lies within the aliasing range
    sigma = (bound.sqrt() * per_radian).clamp_max(packet.acquisition.aliasing_speed)
    return DopplerEstimates(-torch.atan2(imaginary, real) * per_radian, sigma, coherence, accepted)


def vector_doppler(beams: Tensor, speeds: Tensor, sigmas: Tensor) -> tuple[Tensor, Tensor]:
    """Least-squares velocities (n, D) and their deviations (n, D), m/s, from speeds along several beams.

    Args:
        beams: (m, D), unit vectors.
        speeds: (m, n), m/s, along them.
        sigmas: (m, n), m/s, their standard deviations, by which they are weighted.

    Raises:
        ValueError: where the beams do not span the space.
    """
    if torch.linalg.matrix_rank(beams.double(), rtol=1e-3) < beams.shape[1]:
        raise ValueError(f"{len(beams)} beams do not span {beams.shape[1]} dimensions; steer more of them")
    weight = sigmas.square().clamp_min(1e-12).reciprocal().T.to(speeds)
    normal = torch.einsum("nm,ma,mb->nab", weight, beams.to(speeds), beams.to(speeds))
    right = torch.einsum("nm,ma,mn->na", weight, beams.to(speeds), speeds)
    covariance = torch.linalg.inv(normal)
    return (covariance @ right[..., None])[..., 0], covariance.diagonal(dim1=1, dim2=2).sqrt()
