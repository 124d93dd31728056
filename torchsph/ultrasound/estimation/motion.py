"""Motion between images a lag apart, from the peak of their correlation and, along the beam, its phase."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from .correlation import KernelShape
from .peak import Peak, find_peak
from .prepared import Prepared


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of P kernels, all in array order z, y, x; see :class:`Estimates` for what is said of its precision.

    Args:
        shift: (P, 3), m per image.
        correlation: (P,), |rho| at the peak.
        peak_ratio: (P,), highest peak of the wide search over the second.
        curvature: (P, 3), 1/m^2.
        variance: (P, 3), m^2 per image squared, up to a constant.
        lag: (P,), images between those compared.
        sound: (P,), bool, whether there is a peak.
        gap: (P,), by how many turns of the phase the peak of the wide search is off along the beam, 0 to 0.5.
    """

    shift: Tensor
    correlation: Tensor
    peak_ratio: Tensor
    curvature: Tensor
    variance: Tensor
    lag: Tensor
    sound: Tensor
    gap: Tensor

    def better(self, other: Motion, allowed: Tensor) -> Motion:
        """The other motion where that is allowed, sound and promises a smaller total variance; else this one.

        Args:
            other: of the same kernels.
            allowed: (P,), bool.
        """
        take = allowed & other.sound & (~self.sound | (other.variance.sum(1) < self.variance.sum(1)))
        picked = {}
        for name in (field.name for field in fields(self)):
            mine, theirs = getattr(self, name), getattr(other, name)
            picked[name] = torch.where(take.view(-1, *[1] * (mine.dim() - 1)), theirs, mine)
        # the ratio of peaks and the gap are those of the wide search: refinements see one peak alone
        kept = {"peak_ratio": self.peak_ratio, "gap": self.gap, "sound": self.sound | take}
        return Motion(**picked | kept)


def find_motion(
    images: Prepared,
    lag: int,
    corner: Tensor,
    offset: Tensor,
    shape: KernelShape,
    beam: Tensor,
    *,
    ramp: Tensor | None,
    prior: Motion | None,
    phase: bool,
) -> Motion:
    """Motion between images a lag apart.

    Args:
        images: the packet, prepared.
        lag: images between those compared.
        corner: (P, 3), first nodes of the kernels.
        offset: (P, 3), nodes, around which motion is searched.
        shape: of kernels and search.
        beam: (P, 3), unit vectors along the beams.
        ramp: (P, 3), rad per node and image, see :func:`correlate`.
        prior: what is known of the motion, which then tells the whole turns of the phase; ``None`` = the peak
            itself tells them.
        phase: whether the axial component is that of the correlation's phase.
    """
    rho = images.backend.correlate(images.volume, lag, corner, offset, shape, ramp=ramp)
    active = list(images.active)
    peak = find_peak(rho.squeeze(1) if 0 not in active else rho)
    spacing, along = images.spacing[active], beam[:, active]
    start = offset[:, active] * spacing
    shift, gap = start + peak.lag * spacing, torch.zeros_like(peak.ratio)
    if phase:
        guess = shift if prior is None else prior.shift[:, active] * lag
        axial = _axial_shift(peak, (guess * along).sum(1), images.packet.acquisition.phase_per_metre)
        gap = (axial - (guess * along).sum(1)).abs() * images.packet.acquisition.phase_per_metre / (2 * math.pi)
        # a lag in nodes is lag * spacing metres, hence the direction
        shift = start + peak.constrained(along * spacing, axial - (start * along).sum(1)) * spacing
    wave = images.packet.acquisition.phase_per_metre if phase else None
    variance, curvature = _precision(peak, spacing, along, wave)
    count = max(images.volume.shape[-1] - lag, 1)

    def whole(part: Tensor) -> Tensor:
        full = part.new_zeros((len(part), 3))
        full[:, active] = part
        return full

    magnitude = peak.value.abs()
    return Motion(
        whole(shift / lag),
        magnitude,
        peak.ratio,
        whole(curvature),
        whole(variance / (lag**2 * count)),
        torch.full_like(offset[:, 0], lag),
        peak.concave & (magnitude > 0),
        gap,
    )


def _axial_shift(peak: Peak, expected: Tensor, phase_per_metre: float) -> Tensor:
    """Shift along the beam (P,), m, from the phase at the peak, with the whole turns nearest to ``expected``."""
    angle = peak.value.angle()
    turns = torch.round((-phase_per_metre * expected - angle) / (2 * math.pi))
    return -(angle + 2 * math.pi * turns) / phase_per_metre


def _precision(peak: Peak, spacing: Tensor, along: Tensor, phase_per_metre: float | None) -> tuple[Tensor, Tensor]:
    """Variance of the shift per axis, m^2, up to a constant, and relative curvature, 1/m^2, both (P, D).

    The variance of a correlation peak is that of the noise, 1 - rho^2, over its curvature (as in the
    Cramer-Rao bound of Walker & Trahey 1995); of the axial component, over the square of
    the carrier if the phase is used.
    """
    relative = -peak.hessian / torch.outer(spacing, spacing)
    square = peak.value.abs().square()
    noise = (1 - square).clamp_min(1e-6) / square.clamp_min(1e-6)
    variance = noise[:, None] * torch.linalg.inv(relative).diagonal(dim1=1, dim2=2).clamp_min(0)
    if phase_per_metre is not None:
        carrier = noise / phase_per_metre**2
        variance = variance * (1 - along.square()) + carrier[:, None] * along.square()
    return variance, relative.diagonal(dim1=1, dim2=2)
