"""Which phase convention the IQ samples of a packet follow, read off their own phase along depth.

From one depth to the next the phase of speckle in baseband stays, on average, where it is; with the carrier left in
it runs on by 4 pi f / c per metre. The mean of conj(I(z)) I(z + dz) over all samples (Kasai et al. 1985, along depth
instead of time) tells the two apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .acquisition import IQPhase, Packet

FITS = 0.85  # of the best slope's agreement; attenuation and the aperture's angles move the slope by up to a tenth
SEARCHED = 1.6  # carriers, either sign: a conjugated packet or a wrong frequency lies within
STEPS = 129
BINS = 64
COHERENT = 0.1  # share of the power that must agree on a slope
SIGNIFICANT = 8.0  # standard deviations of what noise would show
NEARER = 0.002  # of the best slope's agreement, that a carrier's distance from a convention costs
ALIKE = 0.02  # how much better than the other a convention must fit to be the only one


@dataclass(frozen=True)
class PhaseSlope:
    """How fast the phase of a packet's samples runs along depth.

    Args:
        carriers: slope in units of the carrier's, 4 pi f / c.
        coherence: share of the power that agrees on it.
        baseband: how well slope 0 agrees with the samples beside the best one, at most 1.
        carrier: the same for slope 1, the carrier's own.
        significant: whether the samples agree on a slope more than noise would.
    """

    carriers: float
    coherence: float
    baseband: float
    carrier: float
    significant: bool


def baseband(packet: Packet) -> Packet:
    """The packet in the convention of the estimators, :attr:`IQPhase.BASEBAND`.

    What is stated is believed; what is not is read off the samples. Noise that says nothing is left as it is.

    Args:
        packet: in any convention.

    Raises:
        ValueError: where the samples fit neither convention.
    """
    phase = packet.phase or _detected(packet)
    if phase is IQPhase.BASEBAND:
        return packet if packet.phase is phase else replace(packet, phase=phase)
    turn = packet.acquisition.phase_per_metre * _depths(packet)
    unit = torch.polar(torch.ones_like(turn), -turn).to(packet.iq)
    return replace(packet, iq=packet.iq * unit, phase=IQPhase.BASEBAND)


def phase_slope(packet: Packet) -> PhaseSlope:
    """The slope of the phase along depth on which most of a packet's samples agree.

    Args:
        packet: IQ images; samples that are not finite are passed by.
    """
    wave = packet.acquisition.phase_per_metre
    steps, products, power, pairs = _products(packet)
    if power == 0 or pairs == 0:
        return PhaseSlope(0.0, 0.0, 0.0, 0.0, False)
    slopes = torch.cat([torch.tensor([0.0, 1.0]), torch.linspace(-SEARCHED, SEARCHED, STEPS)]).double()
    scores = _scores(slopes, products, steps, wave)
    highest = float(scores.max())
    # coarse steps do not tell slopes a whole turn apart: of those the one nearest to a convention is meant
    near = torch.minimum(slopes.abs(), (slopes - 1).abs())
    likeliest = slopes[int((scores - NEARER * highest * near).argmax())]
    coherence = highest / power
    return PhaseSlope(
        float(likeliest),
        coherence,
        float(scores[0]) / max(highest, 1e-30),
        float(scores[1]) / max(highest, 1e-30),
        coherence > max(COHERENT, SIGNIFICANT / math.sqrt(pairs)),
    )


def _detected(packet: Packet) -> IQPhase:
    found = phase_slope(packet)
    if not found.significant or min(found.baseband, found.carrier) > 1 - ALIKE:
        return IQPhase.BASEBAND  # nothing to convert, or nothing that a conversion would change
    if max(found.baseband, found.carrier) >= FITS:
        return IQPhase.BASEBAND if found.baseband >= found.carrier else IQPhase.CARRIER
    raise ValueError(
        f"iq: its phase runs along the beams at {found.carriers:.2f} times the carrier's 4 pi f / c, where 0 "
        "(baseband) or 1 (carrier left in) is known; look at frequency, sound speed, the beams' direction and whether "
        "the samples are complex conjugates, or state the packet's phase"
    )


def _depths(packet: Packet) -> Tensor:
    """(*shape), m, float64."""
    return packet.beams.depth(packet.grid.nodes().double()).reshape(packet.grid.shape).to(packet.iq.device)


def _products(packet: Packet) -> tuple[Tensor, Tensor, float, int]:
    """Sums of conj(I(p)) I(p + step) by the depth between the two, with mean depths, m, power and number of pairs.

    Along each axis the step is the longest within a quarter of the carrier's turn, at least one node.
    """
    depth, quarter = _depths(packet), math.pi / 2 / packet.acquisition.phase_per_metre
    finite = torch.isfinite(torch.view_as_real(packet.iq)).all(-1).all(0)
    iq = torch.where(finite, packet.iq, 0)
    steps, products, power, pairs = [], [], 0.0, 0
    for axis, spacing in enumerate(reversed(packet.grid.spacing)):
        nodes = max(1, int(quarter / spacing + 1e-9))
        count = packet.grid.shape[axis] - nodes
        if count < 1:
            continue
        before, after = iq.narrow(axis + 1, 0, count), iq.narrow(axis + 1, nodes, count)
        change = depth.narrow(axis, nodes, count) - depth.narrow(axis, 0, count)
        along = change.abs() > 0.5 * nodes * spacing  # steps across the beams say nothing of depth
        along &= finite.narrow(axis, 0, count) & finite.narrow(axis, nodes, count)
        if not bool(along.any()):
            continue
        product = (before.conj() * after).sum(0)[along].to(torch.complex128)
        power += float((0.5 * (before.abs().square() + after.abs().square())).sum(0)[along].double().sum())
        pairs += int(along.sum())
        mean, total = _binned(change[along], product, nodes * spacing)
        steps.append(mean)
        products.append(total)
    empty = depth.new_zeros(0)
    return torch.cat([empty, *steps]), torch.cat([empty.to(torch.complex128), *products]), power, pairs


def _binned(change: Tensor, product: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Mean depths, m, and sums of the products in bins of like depth."""
    place = ((change / step + 1) * 0.5 * (BINS - 1)).round().long().clamp(0, BINS - 1)
    number = torch.bincount(place, minlength=BINS)
    mean = torch.bincount(place, change, BINS) / number.clamp_min(1)
    real, imaginary = (torch.bincount(place, part, BINS) for part in (product.real, product.imag))
    return mean[number > 0], torch.complex(real, imaginary)[number > 0]


def _scores(slopes: Tensor, products: Tensor, steps: Tensor, wave: float) -> Tensor:
    """How much of the products agrees with each slope, in carriers."""
    turn = slopes.to(steps)[:, None] * wave * steps
    return (products * torch.polar(torch.ones_like(turn), -turn)).real.sum(1)
