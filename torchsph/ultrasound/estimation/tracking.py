"""Blood speckle tracking: velocities from the motion of speckle between the images of a packet.

Normalised cross-correlation of small kernels, pooled over the packet, a parabolic sub-sample peak, and the
echo's phase for the axial component (Grønli 2017, table 3.1; Trahey, Allison & von Ramm 1987 for the method;
Loupas, Powers & Gill 1995 for what the phase adds). Nothing here knows how images are made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..acquisition import Acquisition, Packet, decibel
from .backends import NAMES, choose_backend
from .clutter import ClutterFilter, FIRFilter
from .correlation import KernelShape, triple
from .estimates import Estimates, Flag, bit
from .gates import gates
from .motion import Motion, find_motion
from .prepared import Prepared, prepare

TOLERATED_GAP = 0.25  # turns between the peak's axial shift and the phase's: halfway to the next whole turn
LEAST_CORRELATION = 0.5  # below it peaks of noise are as high, however weak the echoes are said to be


@dataclass(frozen=True)
class SpeckleTracker:
    """Options of speckle tracking; the defaults are those of Grønli 2017, table 3.1.

    Args:
        kernel: m, side of the kernel on every axis; it covers the nearest odd number of image nodes (7 at 1/6
            mm).
        min_samples: nodes per axis that a kernel needs; coarse images widen it, a cut at the border flags it.
        search: m/s, greatest speed per component.
        lags: images between compared ones; the first is searched, each further one refines where it is more
            certain.
        phase: refine the axial component by the phase of the correlation.
        follow_shear: turn the samples of a kernel back by what axial velocity differences turn them between
            images (from the mean phase of successive images), so that shear does not make their products cancel.
        clutter: filter over the packet; ``None`` = already filtered.
        min_snr: dB, least power over that of thermal noise after the filter, where the packet states its noise;
            ``None`` = no gate.
        max_snr: dB, greatest power over noise: tissue is some 40 dB brighter than blood, and what of it passes
            the filter correlates better than any blood; ``None`` = no gate.
        min_blood: dB, least share of the unfiltered power that passes the filter, or ``None``.
        min_response: dB, least response of the clutter filter at the estimate's own Doppler frequency, or
            ``None``.
        min_correlation: least correlation, of what noise and shear leave: echoes that make up a share s of the
            power need s times as much, and so do those of which shear (where it is followed) leaves a share s of
            the correlation; but at least 0.5.
        lone_correlation: the same where no longer lag confirms the first, whose axial phase may then be a whole
            turn off.
        tile: points worked on at a time, which bounds memory.
        backend: who does the sums: "cpu", compiled code, "reference", torch on any device, or "auto".
    """

    kernel: float = 1e-3
    min_samples: int = 3
    search: float = 1.0
    lags: tuple[int, ...] = (1, 2, 4)
    phase: bool = True
    follow_shear: bool = True
    clutter: ClutterFilter | None = field(default_factory=FIRFilter)
    min_snr: float | None = 9.0
    max_snr: float | None = None
    min_blood: float | None = -60.0
    min_response: float | None = -12.0
    min_correlation: float = 0.8
    lone_correlation: float = 0.9
    tile: int = 512
    backend: str = "auto"

    def __post_init__(self) -> None:
        for name in ("kernel", "search"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")
        if self.min_samples < 3 or self.tile < 1:
            raise ValueError("min_samples must be >= 3 and tile >= 1")
        if self.backend not in NAMES:
            raise ValueError(f"backend must be one of {', '.join(NAMES)}, got {self.backend!r}")
        if not self.lags or list(self.lags) != sorted(set(self.lags)) or self.lags[0] < 1:
            raise ValueError(f"lags must be increasing whole numbers >= 1, got {self.lags!r}")
        for name in ("min_correlation", "lone_correlation"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must lie in [0, 1), got {getattr(self, name)!r}")

    def track(self, packet: Packet, points: Tensor) -> Estimates:
        """Velocities at the image nodes nearest to some points, see :func:`track`."""
        return track(packet, points, self)


def track(packet: Packet, points: Tensor, options: SpeckleTracker) -> Estimates:
    """Velocities at the image nodes nearest to some points.

    Args:
        packet: IQ images.
        points: (n, D), m, inside the image.
        options: of the tracker.

    Raises:
        ValueError: where no two images are left to compare, or points lie outside the image.
    """
    images = prepare(
        packet,
        options.clutter,
        kernel=options.kernel,
        min_samples=options.min_samples,
        reach=options.search * packet.acquisition.interval * options.lags[0],
        least_images=1 + options.lags[0],
        follow_shear=options.follow_shear,
        backend=choose_backend(options.backend, packet.iq.device),
    )
    nodes, beam = images.nearest_nodes(points), images.directions(points)
    starts = range(0, max(len(points), 1), options.tile)
    tiles = [slice(start, start + options.tile) for start in starts]
    return Estimates.joined([_track_tile(images, nodes[tile], beam[tile], options) for tile in tiles])


def _track_tile(images: Prepared, nodes: Tensor, beam: Tensor, options: SpeckleTracker) -> Estimates:
    """Estimates at a tile of nodes (P, 3); only those that pass the gates are correlated."""
    snr, share, flags = gates(
        images,
        nodes,
        min_samples=options.min_samples,
        min_blood=options.min_blood,
        min_snr=options.min_snr,
        max_snr=options.max_snr,
    )
    axes = list(reversed(images.active))
    packet, interval = images.packet, images.packet.acquisition.interval
    kept = torch.nonzero(flags == 0)[:, 0]
    ramp = images.ramp(nodes)
    within = None if ramp is None else ramp[kept]
    motion = _follow(images, nodes[kept], beam[kept], within, options)
    velocity = motion.shift[:, axes] / interval
    response = _response((motion.shift * beam[kept]).sum(1), packet.acquisition, options.clutter)
    coherent = _echo_share(snr[kept]) * (1 if within is None else _sheared(motion, within / images.spacing))
    flags[kept] = _doubts(velocity, motion, coherent, response, options)

    def spread(values: Tensor, otherwise: float) -> Tensor:
        return values.new_full((len(nodes), *values.shape[1:]), otherwise).index_copy(0, kept, values)

    return Estimates(
        velocity=spread(velocity, 0.0),
        correlation=spread(motion.correlation, 0.0),
        peak_ratio=spread(motion.peak_ratio, 1.0),
        curvature=spread(motion.curvature[:, axes], 0.0),
        # of what was not correlated nothing is known but that it is within the range
        variance=spread(motion.variance[:, axes] / interval**2, options.search**2),
        power=share,
        snr=snr,
        response=spread(response, 0.0),
        shear=images.shear(ramp, len(nodes)),
        bend=images.bend(nodes),
        lag=spread(motion.lag, options.lags[0]),
        flags=flags,
    )


def _follow(images: Prepared, nodes: Tensor, beam: Tensor, ramp: Tensor | None, options: SpeckleTracker) -> Motion:
    """The first lag searched over the whole range, each further one around what is known by then."""
    corner, wide = images.corner(nodes), images.shape
    motion = find_motion(
        images,
        options.lags[0],
        corner,
        torch.zeros_like(nodes),
        wide,
        beam,
        ramp=ramp,
        prior=None,
        phase=options.phase,
    )
    narrow = KernelShape(wide.half, triple(min(s, 1) for s in wide.search))
    for lag in (lag for lag in options.lags[1:] if lag < images.volume.shape[-1]):
        offset = (motion.shift * lag / images.spacing).round().long()
        fits = images.holds(nodes + offset)
        offset = torch.where(fits[:, None], offset, 0)
        found = find_motion(images, lag, corner, offset, narrow, beam, ramp=ramp, prior=motion, phase=options.phase)
        motion = motion.better(found, fits)
    return motion


def _response(axial: Tensor, acquisition: Acquisition, clutter: ClutterFilter | None) -> Tensor:
    """Response (P,), dB, of the filter to echoes that move ``axial`` m per image along the beam."""
    if clutter is None:
        return torch.zeros_like(axial)
    frequency = (axial * acquisition.phase_per_metre / (2 * math.pi)).double().cpu().numpy()
    return decibel(torch.from_numpy(clutter.response(frequency)).clamp_min(1e-12)).to(axial)


def _echo_share(snr: Tensor) -> Tensor:
    """Share (P,) of the power that is not noise, from power over noise, dB; 1 where that is unknown."""
    return torch.nan_to_num(1 - 10 ** (-snr / 10), nan=1.0)


def _sheared(motion: Motion, gradient: Tensor) -> Tensor:
    """Correlation (P,) that the true lag has left where echoes turn by ``gradient`` (P, 3), rad/m per image.

    Turning a kernel's samples back does nothing about the scatterers within one sample: a Gaussian point spread
    of amplitude deviation s keeps exp(-g^2 s^2 / 4) of its correlation (the transform of its intensity at g,
    between two images), and the curvature of the correlation's peak is 1 / (2 s^2).
    """
    turned = gradient * motion.lag[:, None]
    exponent = torch.where(motion.curvature > 0, turned.square() / (8 * motion.curvature.clamp_min(1e-12)), 0)
    return torch.exp(-exponent.sum(1))


def _doubts(velocity: Tensor, motion: Motion, coherent: Tensor, response: Tensor, options: SpeckleTracker) -> Tensor:
    """Flags (P,) of correlated points; velocity (P, D) m/s, correlation to be expected (P,), response (P,), dB."""
    flags = bit(~motion.sound, Flag.FLAT)
    # a fit that overshoots by 2 % of the range is still the range's own edge
    flags |= bit((velocity.abs() > options.search * 1.02).any(1) & motion.sound, Flag.EDGE)
    if options.min_response is not None:
        flags |= bit(response < options.min_response, Flag.STOPPED)
    flags |= bit(motion.gap > TOLERATED_GAP, Flag.AMBIGUOUS)
    alone = (motion.lag == options.lags[0]) & (len(options.lags) > 1)
    least = torch.where(alone, max(options.lone_correlation, options.min_correlation), options.min_correlation)
    floor = min(LEAST_CORRELATION, options.min_correlation)
    return flags | bit(motion.correlation < (least * coherent).clamp_min(floor), Flag.DECORRELATED)
