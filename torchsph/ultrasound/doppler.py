"""Doppler: the velocity along the beam from the phase between images, and full vectors from several beams.

The lag-one autocorrelation of Kasai et al. (IEEE Trans. Sonics Ultrason. 32, 1985). Speeds beyond
:attr:`Acquisition.aliasing_speed` wrap around, as on every scanner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from geometry import Recording

from .acquisition import Beams, Packet
from .clutter import ClutterFilter, FIRFilter
from .fields import box_sum
from .measurement import Canvas, ScannerOptions, scanned


@dataclass(frozen=True)
class ColourDoppler:
    """Autocorrelation over a window: side ``window`` m, ``clutter`` filter (``None`` = already filtered),
    ``min_snr`` dB over the packet's noise after the filter (``None`` = no gate)."""

    window: float = 1e-3
    clutter: ClutterFilter | None = field(default_factory=FIRFilter)
    min_snr: float | None = 3.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.window) and self.window > 0):
            raise ValueError(f"window must be positive and finite, got {self.window!r}")


@dataclass(frozen=True, eq=False)
class DopplerEstimates:
    """Of n points: ``speed`` along the beam, positive away from the probe, and its deviation ``sigma``, m/s;
    ``coherence`` |R(1)| / R(0) in [0, 1]; ``accepted`` bool."""

    speed: Tensor
    sigma: Tensor
    coherence: Tensor
    accepted: Tensor


def colour_doppler(packet: Packet, points: Tensor, options: ColourDoppler) -> DopplerEstimates:
    """Axial velocities at the image nodes nearest to ``points`` (n, D), m.

    With R(k) the sum of conj(I(t)) I(t + k) over images and window, speed = -arg R(1) c PRF / (4 pi f), and

        sigma^2 = (1 - coherence^2) / (2 N coherence^2) (c PRF / (4 pi f))^2

    with N pairs of images: the Cramer-Rao bound for one speckle per window, larger than the error if it holds
    several. Raises ValueError where the clutter filter leaves fewer than two images or points lie outside.
    """
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
    real, imaginary, power, count = sums[(slice(None), *place.unbind(1))]
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
    """Least-squares velocities (n, D) and deviations (n, D) from speeds (m, n) along unit ``beams`` (m, D).

    Each speed is weighted by its own ``sigmas`` (m, n). Raises ValueError where the beams do not span the
    space.
    """
    if torch.linalg.matrix_rank(beams.double(), rtol=1e-3) < beams.shape[1]:
        raise ValueError(f"{len(beams)} beams do not span {beams.shape[1]} dimensions; steer more of them")
    weight = sigmas.square().clamp_min(1e-12).reciprocal().T.to(speeds)
    normal = torch.einsum("nm,ma,mb->nab", weight, beams.to(speeds), beams.to(speeds))
    right = torch.einsum("nm,ma,mn->na", weight, beams.to(speeds), speeds)
    covariance = torch.linalg.inv(normal)
    return (covariance @ right[..., None])[..., 0], covariance.diagonal(dim1=1, dim2=2).sqrt()


@dataclass(frozen=True)
class DopplerOptions(ScannerOptions):
    """Options of :func:`measure_doppler`: a scanner and an averaging ``window``, m.

    steering: ``None`` for colour Doppler along one beam; an angle in degrees for vector Doppler from beams
    tilted by it to both sides along every lateral axis.
    """

    window: float = 1e-3
    steering: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        ColourDoppler(self.window)
        if self.steering is not None and not 0 < self.steering < 80:
            raise ValueError(f"steering must lie between 0 and 80 degrees, got {self.steering!r}")

    def directions(self, dimension: int) -> list[tuple[float, ...]]:
        """Unit vectors of the beams."""
        centre = torch.tensor(self.echo_model(dimension).beams.direction, dtype=torch.float64)
        if self.steering is None:
            return [tuple(centre.tolist())]
        # an orthonormal frame whose first vector is the central beam
        frame = torch.linalg.qr(torch.cat([centre[:, None], torch.eye(dimension, dtype=torch.float64)], 1))[0]
        tilt = math.radians(self.steering)
        sides = [sign * frame[:, axis] for axis in range(1, dimension) for sign in (-1, 1)]
        return [tuple((math.cos(tilt) * centre + math.sin(tilt) * side).tolist()) for side in sides]


def measure_doppler(
    true: Recording, options: DopplerOptions, seed: int, *, progress: bool = False
) -> Recording:
    """What a scanner's Doppler reports of ``true``: every K-th frame, with ``weight`` (coherence) and
    ``sigma``.

    Colour Doppler gives a recording with ``beam``, its velocity (v . b) b; vector Doppler one of full
    vectors.
    """
    base = options.echo_model(true.dimension)
    directions = options.directions(true.dimension)
    models = [replace(base, beams=Beams(direction)) for direction in directions]
    doppler = ColourDoppler(options.window, options.filter())
    canvas = Canvas(true, list(range(0, true.frames, options.every)))
    for frame, points, packets in scanned(true, options, models, seed, options.window, progress=progress):
        if not packets:
            continue
        found = [colour_doppler(packet, points, doppler) for packet in packets]
        beams = torch.tensor(directions, dtype=found[0].speed.dtype, device=found[0].speed.device)
        if options.steering is None:
            velocity, sigma = (
                found[0].speed[:, None] * beams,
                found[0].sigma[:, None].expand(-1, true.dimension),
            )
        else:
            velocity, sigma = vector_doppler(
                beams, torch.stack([f.speed for f in found]), torch.stack([f.sigma for f in found])
            )
        accepted = torch.stack([f.accepted for f in found]).all(0)
        coherence = torch.stack([f.coherence for f in found]).amin(0)
        canvas.paint(frame, velocity, sigma, torch.where(accepted, coherence, 0))
    kind = "colour Doppler" if options.steering is None else f"vector Doppler, {options.steering:g} degrees"
    return canvas.recording(
        f"{kind} of simulated echoes, {options.summary()}, window {options.window * 1e3:g} mm, seed {seed}",
        directions[0] if options.steering is None else None,
    )
