"""Blood speckle tracking: velocities from the motion of speckle between the images of a packet.

Normalised cross-correlation of small kernels, pooled over the packet, a parabolic sub-sample peak, and the
echo's phase for the axial component (table 3.1 of the thesis; Trahey, Allison & von Ramm, IEEE TBME 34,
1987, for the method; Loupas, Powers & Gill, IEEE UFFC 42, 1995, for what the phase adds). Nothing here
knows how images are made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntFlag

import torch
import torch.nn.functional as F
from torch import Tensor

from .acquisition import Packet
from .clutter import ClutterFilter, FIRFilter
from .correlation import KernelShape, correlate, gather, power
from .fields import convolve_axis
from .peak import Peak, find_peak


class Flag(IntFlag):
    """Why an estimate is not to be believed; several can be set."""

    NONE = 0
    EDGE = 1  # speed at or beyond the search range
    WEAK = 2  # too little blood power over noise or clutter
    SAMPLES = 4  # the image cuts the kernel to fewer samples than required
    FLAT = 8  # the correlation has no peak (constant image, no scatterers)
    NOT_FINITE = 16  # NaN or infinity in the kernel
    DECORRELATED = 32  # correlation below the threshold


@dataclass(frozen=True)
class SpeckleTracker:
    """Options of speckle tracking; the defaults are table 3.1 of the thesis.

    kernel: side of the kernel, m, on every axis; it covers the nearest odd number of image nodes (7 at 1/6
    mm). min_samples: nodes per axis that a kernel needs; coarse images widen it, a cut at the border flags
    it. search: greatest speed per component, m/s.
    lags: images between compared ones; the first is searched, each further one refines where it is more
    certain. phase: refine the axial component by the phase of the correlation.
    follow_shear: turn the samples of a kernel back by what axial velocity differences turn them between
        images (from the mean phase of successive images), so that shear does not make their products cancel.
    clutter: filter over the packet, ``None`` = already filtered.
    min_snr: least power over that of thermal noise after the filter, dB, where the packet states its noise;
        ``None`` = no gate. min_blood: least share of the unfiltered power that passes the filter, dB, or
        ``None``.
    min_correlation: least correlation; lone_correlation: the same where no longer lag confirms the first,
        whose axial phase may then be a whole turn off. tile: points correlated at a time, which bounds
        memory.
    """

    kernel: float = 1e-3
    min_samples: int = 3
    search: float = 1.0
    lags: tuple[int, ...] = (1, 2, 4)
    phase: bool = True
    follow_shear: bool = True
    clutter: ClutterFilter | None = field(default_factory=FIRFilter)
    min_snr: float | None = 6.0
    min_blood: float | None = -60.0
    min_correlation: float = 0.7
    lone_correlation: float = 0.8
    tile: int = 64

    def __post_init__(self) -> None:
        for name in ("kernel", "search"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)!r}")
        if self.min_samples < 3 or self.tile < 1:
            raise ValueError("min_samples must be >= 3 and tile >= 1")
        if not self.lags or list(self.lags) != sorted(set(self.lags)) or self.lags[0] < 1:
            raise ValueError(f"lags must be increasing whole numbers >= 1, got {self.lags!r}")
        for name in ("min_correlation", "lone_correlation"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must lie in [0, 1), got {getattr(self, name)!r}")

    def track(self, packet: Packet, points: Tensor) -> Estimates:
        """Velocities at the image nodes nearest to ``points`` (n, D), m. See :func:`track`."""
        return track(packet, points, self)


@dataclass(frozen=True, eq=False)
class Estimates:
    """What a tracker says of each of n points; components in the order x, y, z.

    velocity (n, D) m/s. correlation (n,) of the accepted lag, in [0, 1]. peak_ratio (n,): highest peak of the
    search over the second. curvature (n, D): -(second derivative of log |rho|) per axis, 1/m^2. variance
    (n, D): (m/s)^2 up to a constant, what correlation and curvature say of the precision; calibration makes a
    ``sigma`` of it. power (n,): share of the unfiltered power that passed the clutter filter, dB. snr
    (n,): power over thermal noise after the filter, dB (NaN if the noise is unknown). lag (n,): images
    between those compared. flags (n,): :class:`Flag` bits, 0 = accepted.
    """

    velocity: Tensor
    correlation: Tensor
    peak_ratio: Tensor
    curvature: Tensor
    variance: Tensor
    power: Tensor
    snr: Tensor
    lag: Tensor
    flags: Tensor

    @property
    def accepted(self) -> Tensor:
        """Points (n,) bool without any flag."""
        return self.flags == 0


def track(packet: Packet, points: Tensor, options: SpeckleTracker) -> Estimates:
    """Track ``points`` (n, D) through a packet. ValueError where no two images are left to compare."""
    images = _prepare(packet, options)
    shape = KernelShape(images.half, images.search)
    nodes = images.nearest_nodes(points)
    beam = packet.beams.directions(points.to(images.real)).flip(-1)  # array order, as everything inside
    beam = F.pad(beam, (3 - beam.shape[1], 0)).to(images.volume.device)
    tiles = [
        _track_tile(
            images, nodes[start : start + options.tile], beam[start : start + options.tile], shape, options
        )
        for start in range(0, len(points), options.tile)
    ]
    if not tiles:
        tiles = [_track_tile(images, nodes, beam, shape, options)]
    return Estimates(*(torch.cat(parts) for parts in zip(*tiles, strict=True)))


@dataclass(frozen=True, eq=False)
class _Images:
    """Filtered images in the layout of :mod:`correlation`, padded so that every block fits.

    volume (Z, Y, X, T); raw_power, power (Z, Y, X): mean squares over the images before and after the
    filter, and finite (Z, Y, X) whether all are finite, all padded by ``margin``. half, search: nodes per
    array axis.
    """

    volume: Tensor
    raw_power: Tensor
    power: Tensor
    finite: Tensor
    inside: Tensor
    half: tuple[int, int, int]
    search: tuple[int, int, int]
    margin: tuple[int, int, int]
    spacing: Tensor
    packet: Packet
    noise: float | None
    turn_gradient: Tensor | None
    active: tuple[int, ...]

    @property
    def real(self) -> torch.dtype:
        return self.power.dtype

    def ramp(self, corner: Tensor) -> Tensor | None:
        """Gradient (P, 3) of the echoes' turn at the middle of kernels."""
        if self.turn_gradient is None:
            return None
        z, y, x = (corner + corner.new_tensor(self.half)).unbind(1)
        return self.turn_gradient[z, y, x]

    def holds(self, nodes: Tensor) -> Tensor:
        """Whether kernels around ``nodes`` (P, 3), and one node beyond, lie inside the image: (P,) bool."""
        last = nodes.new_tensor([1] * (3 - self.packet.grid.dimension) + list(self.packet.grid.shape)) - 1
        reach = nodes.new_tensor([h + (h > 0) for h in self.half])
        return ((nodes >= reach) & (nodes + reach <= last)).all(1)

    def nearest_nodes(self, points: Tensor) -> Tensor:
        """Unpadded node numbers (n, 3), array order, of points (n, D)."""
        place = self.packet.grid.locate(points.double()).round().long().flip(-1).to(self.volume.device)
        last = torch.tensor(self.packet.grid.shape, device=place.device) - 1
        if bool(((place < 0) | (place > last)).any()):
            raise ValueError("some points to track lie outside the image; select those inside its grid")
        return F.pad(place, (3 - place.shape[1], 0))


def _prepare(packet: Packet, options: SpeckleTracker) -> _Images:
    if len(packet.iq) < 2:
        raise ValueError(f"speckle tracking compares images; the packet has {len(packet.iq)}")
    dimension = packet.grid.dimension
    finite = torch.isfinite(_mean_power(packet.iq))
    clean = packet.iq if bool(finite.all()) else torch.where(finite, packet.iq, 0)
    filtered = clean if options.clutter is None else options.clutter.apply(clean)
    if len(filtered) < 1 + options.lags[0]:
        raise ValueError(
            f"{len(filtered)} of {len(packet.iq)} images are left after the clutter filter, too few for a "
            f"lag of {options.lags[0]}; use a longer packet or a shorter filter"
        )
    spacing = list(reversed(packet.grid.spacing))
    reach = options.search * packet.acquisition.interval * options.lags[0]
    half = [max(round(options.kernel / (2 * s)), (options.min_samples - 1) // 2) for s in spacing]
    search = [math.ceil(reach / s + 0.5 - 1e-9) for s in spacing]
    margin = [h + n for h, n in zip(half, search, strict=True)]
    lead = 3 - dimension
    pad = [0] * lead + margin
    edges = [side for m in reversed(pad) for side in (m, m)]

    def padded(field: Tensor) -> Tensor:
        return F.pad(field.reshape(*[1] * lead, *field.shape), edges)

    volume = torch.stack([padded(image) for image in filtered], -1)
    gain = 1.0 if options.clutter is None else options.clutter.noise_gain(len(packet.iq))
    return _Images(
        volume, padded(_mean_power(clean)), padded(_mean_power(filtered)),
        padded(finite.to(volume.real.dtype)), padded(torch.ones_like(clean[0].real)),
        tuple([0] * lead + half), tuple([0] * lead + search), tuple(pad),
        torch.tensor([1.0] * lead + spacing, dtype=volume.real.dtype, device=volume.device),
        packet, None if packet.noise is None else packet.noise * gain,
        _turn_gradient(volume, half) if options.follow_shear else None,
        tuple(range(lead, 3)),
    )  # fmt: skip


def _mean_power(images: Tensor) -> Tensor:
    """Mean square (*shape) of images (T, *shape), one at a time to spare memory."""
    total = power(images[0])
    for image in images[1:]:
        total += power(image)
    return total / len(images)


def _turn_gradient(volume: Tensor, half: list[int]) -> Tensor:
    """Change along each axis, (Z, Y, X, 3) rad per node, of how much echoes turn from one image to the next.

    The turn is the phase of the lag-one autocorrelation (Kasai et al., IEEE Trans. Sonics Ultrason. 32,
    1985); its gradient is that of neighbouring nodes against each other, averaged over twice the kernel:
    with only three numbers per kernel taken from the data, little of the speckle's own phase gets into them.
    """
    product = (volume[..., :-1].conj() * volume[..., 1:]).sum(-1)
    lead = 3 - len(half)
    parts = []
    for axis in range(3):
        if axis < lead:
            parts.append(torch.zeros_like(product.real))
            continue
        # symmetric: a node with the next, and the one before with it
        step = product.roll(1, axis).conj() * product
        step = step + step.roll(-1, axis)
        mean = torch.stack([step.real, step.imag])
        for number, h in enumerate(half):
            mean = convolve_axis(mean, mean.new_ones(4 * h + 1), 1 + lead + number, padded=True)
        parts.append(torch.atan2(mean[1], mean[0]))
    return torch.stack(parts, -1)


def _track_tile(
    images: _Images, nodes: Tensor, beam: Tensor, shape: KernelShape, options: SpeckleTracker
) -> tuple[Tensor, ...]:
    """The fields of :class:`Estimates` for a tile of nodes (P, 3)."""
    corner = nodes + nodes.new_tensor(images.margin) - nodes.new_tensor(images.half)
    snr, share, flags = _gates(images, corner, shape, options)
    still = torch.zeros_like(nodes)
    state = _estimate(images, corner, still, options.lags[0], shape, beam, None, options)
    fine = KernelShape(images.half, tuple(min(s, 1) for s in images.search))
    for lag in options.lags[1:]:
        if images.volume.shape[-1] <= lag:
            break
        guess = state.motion * lag
        offset = (guess / images.spacing).round().long()
        fits = images.holds(nodes + offset)
        offset = torch.where(fits[:, None], offset, 0)
        state = state.better(_estimate(images, corner, offset, lag, fine, beam, state, options), fits)
    active = list(images.active)
    interval = images.packet.acquisition.interval
    velocity = state.motion[:, active].flip(-1) / interval
    flags = flags | _bit(~state.sound, Flag.FLAT)
    # a fit that overshoots by 2 % of the range is still the range's own edge
    flags |= _bit((velocity.abs() > options.search * 1.02).any(1) & state.sound, Flag.EDGE)
    alone = (state.lag == options.lags[0]) & (len(options.lags) > 1)
    least = torch.where(
        alone, max(options.lone_correlation, options.min_correlation), options.min_correlation
    )
    flags |= _bit(state.correlation < least, Flag.DECORRELATED)
    return (
        velocity, state.correlation, state.peak_ratio, state.curvature[:, active].flip(-1),
        state.variance[:, active].flip(-1) / interval**2, share, snr, state.lag, flags,
    )  # fmt: skip


def _bit(condition: Tensor, flag: Flag) -> Tensor:
    return condition.to(torch.int32) * int(flag)


def _gates(
    images: _Images, corner: Tensor, shape: KernelShape, options: SpeckleTracker
) -> tuple[Tensor, Tensor, Tensor]:
    """Power over noise (dB), share of power passed (dB) and the flags that need no correlation, each (P,)."""

    def kernel(field: Tensor) -> Tensor:
        return gather(field[..., None].contiguous(), corner, shape.size)[..., 0].transpose(0, 1)

    inside, finite = kernel(images.inside), kernel(images.finite)
    count = inside.sum((1, 2, 3)).clamp_min(1)
    passed = kernel(images.power).sum((1, 2, 3)) / count
    before = kernel(images.raw_power).sum((1, 2, 3)) / count
    share = 10 * torch.log10(passed / before.clamp_min(torch.finfo(before.dtype).tiny))
    flags = _bit((finite < inside).any(1).any(1).any(1), Flag.NOT_FINITE)
    for axis in images.active:
        others = [a + 1 for a in range(3) if a != axis]
        flags |= _bit(inside.amax(others).sum(1) < options.min_samples, Flag.SAMPLES)
    weak = passed <= 0
    if options.min_blood is not None:
        weak |= share < options.min_blood
    snr = torch.full_like(share, math.nan)
    if images.noise:
        snr = 10 * torch.log10(passed / images.noise)
        if options.min_snr is not None:
            weak |= snr < options.min_snr
    return snr, share, flags | _bit(weak, Flag.WEAK)


@dataclass(frozen=True, eq=False)
class _State:
    """The best estimate so far; motion (P, 3) in m per image, array order."""

    motion: Tensor
    correlation: Tensor
    peak_ratio: Tensor
    curvature: Tensor
    variance: Tensor
    lag: Tensor
    sound: Tensor

    def better(self, other: _State, allowed: Tensor) -> _State:
        """Takes ``other`` where allowed (P,), sound and promising a smaller total variance."""
        take = allowed & other.sound & (~self.sound | (other.variance.sum(1) < self.variance.sum(1)))

        def pick(name: str) -> Tensor:
            mine, theirs = getattr(self, name), getattr(other, name)
            return torch.where(take.view(-1, *[1] * (mine.dim() - 1)), theirs, mine)

        names = ("motion", "correlation", "curvature", "variance", "lag")
        # the ratio of peaks is that of the wide search: refinements see one peak alone
        return _State(
            peak_ratio=self.peak_ratio, sound=self.sound | take, **{name: pick(name) for name in names}
        )


def _estimate(
    images: _Images, corner: Tensor, offset: Tensor, lag: int, shape: KernelShape, beam: Tensor,
    prior: _State | None, options: SpeckleTracker,
) -> _State:  # fmt: skip
    rho = correlate(images.volume, corner, offset, lag, shape, ramp=images.ramp(corner))
    active = list(images.active)
    peak = find_peak(rho.squeeze(1) if 0 not in active else rho)
    spacing, along = images.spacing[active], beam[:, active]
    start = offset[:, active] * spacing
    shift = start + peak.lag * spacing
    magnitude = peak.value.abs()
    if options.phase:
        k = images.packet.acquisition.phase_per_metre
        expected = (shift * along).sum(1) if prior is None else (prior.motion[:, active] * along).sum(1) * lag
        axial = (
            -(
                peak.value.angle()
                + 2 * math.pi * torch.round((-k * expected - peak.value.angle()) / (2 * math.pi))
            )
            / k
        )
        # a lag in nodes is lag * spacing metres, hence the direction
        lag_nodes = peak.constrained(along * spacing, axial - (start * along).sum(1))
        shift = start + lag_nodes * spacing
    variance, curvature = _precision(peak, magnitude, spacing, along, lag, options, images)
    count = max(images.volume.shape[-1] - lag, 1)
    whole = offset.new_zeros((len(offset), 3)).to(shift)
    motion, curves, spread = whole.clone(), whole.clone(), whole.clone()
    motion[:, active], curves[:, active], spread[:, active] = (
        shift / lag,
        curvature,
        variance / (lag**2 * count),
    )
    sound = peak.concave & (magnitude > 0)
    return _State(motion, magnitude, peak.ratio, curves, spread, torch.full_like(offset[:, 0], lag), sound)


def _precision(
    peak: Peak,
    magnitude: Tensor,
    spacing: Tensor,
    along: Tensor,
    lag: int,
    options: SpeckleTracker,
    images: _Images,
) -> tuple[Tensor, Tensor]:
    """Variance of the shift per axis, m^2, up to a constant, and relative curvature, 1/m^2, both (P, D).

    The variance of a correlation peak is that of the noise, 1 - rho^2, over its curvature (as in the
    Cramer-Rao bound of Walker & Trahey, IEEE UFFC 42, 1995); of the axial component, over the square of
    the carrier if the phase is used.
    """
    metric = torch.outer(spacing, spacing)
    relative = -peak.hessian / metric
    noise = (1 - magnitude.square()).clamp_min(1e-6) / magnitude.square().clamp_min(1e-6)
    variance = noise[:, None] * torch.linalg.inv(relative).diagonal(dim1=1, dim2=2).clamp_min(0)
    if options.phase:
        carrier = noise / images.packet.acquisition.phase_per_metre**2
        variance = variance * (1 - along.square()) + carrier[:, None] * along.square()
    return variance, relative.diagonal(dim1=1, dim2=2)
