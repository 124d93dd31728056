"""The scanner's point-spread function at baseband: how one scatterer looks in an IQ image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Protocol

import torch
from torch import Tensor

from geometry.grids.fields import fwhm_to_deviation

EXTENT = 3.7  # deviations at which a Gaussian has fallen to 1e-3: cut in space
BAND = 3.0  # deviations kept free of aliasing in k-space, where the Gaussian has fallen to 1e-2


class PointSpread(Protocol):
    """What image formation needs to know of a point-spread function h(x), peak 1 at the origin.

    ``direction`` (D,) is everywhere the unit vector along the beams.
    """

    def transform(self, wavenumbers: list[Tensor], direction: tuple[float, ...]) -> Tensor:
        """Fourier integral of h, m^D.

        Args:
            wavenumbers: D tensors, rad/m, in the order x, y, z, that broadcast to the result's shape.
            direction: (D,), unit vector along the beams.
        """
        ...

    def energy(self, dimension: int) -> float:
        """Integral of |h|^2, m^D."""
        ...

    def reach(self, direction: tuple[float, ...]) -> tuple[float, ...]:
        """Distance per axis, m, beyond which h is negligible."""
        ...

    def band(self, direction: tuple[float, ...]) -> tuple[float, ...]:
        """Wavenumber per axis, rad/m, beyond which the transform is negligible."""
        ...


@dataclass(frozen=True)
class GaussianPointSpread:
    """Gaussian envelope; the carrier is in the phase of the scatterers (see :class:`Packet`).

    Args:
        axial: m, full width at half amplitude (two-way) along the beam.
        lateral: m, the same across the beam, in all directions.
    """

    axial: float = 0.5e-3
    lateral: float = 1.2e-3

    def __post_init__(self) -> None:
        for name in ("axial", "lateral"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} width must be positive and finite, got {getattr(self, name)!r}")

    def _covariance(self, direction: tuple[float, ...]) -> Tensor:
        """(D, D) of the envelope: axial along the beam, lateral across."""
        beam = torch.tensor(direction, dtype=torch.float64)
        along = torch.outer(beam, beam)
        across = torch.eye(len(direction), dtype=torch.float64) - along
        return fwhm_to_deviation(self.axial) ** 2 * along + fwhm_to_deviation(self.lateral) ** 2 * across

    def transform(self, wavenumbers: list[Tensor], direction: tuple[float, ...]) -> Tensor:
        """See :class:`PointSpread`."""
        covariance = self._covariance(direction)
        exponent = torch.zeros((), dtype=wavenumbers[0].dtype, device=wavenumbers[0].device)
        for a, b in product(range(len(direction)), repeat=2):
            if abs(float(covariance[a, b])) > 1e-15 * float(covariance.diagonal().max()):
                exponent = exponent + float(covariance[a, b]) * wavenumbers[a] * wavenumbers[b]
        return math.sqrt((2 * math.pi) ** len(direction) * float(covariance.det())) * torch.exp(-0.5 * exponent)

    def energy(self, dimension: int) -> float:
        """See :class:`PointSpread`."""
        axial, lateral = fwhm_to_deviation(self.axial), fwhm_to_deviation(self.lateral)
        return math.pi ** (dimension / 2) * axial * lateral ** (dimension - 1)

    def reach(self, direction: tuple[float, ...]) -> tuple[float, ...]:
        """See :class:`PointSpread`."""
        return tuple(EXTENT * math.sqrt(float(v)) for v in self._covariance(direction).diagonal())

    def band(self, direction: tuple[float, ...]) -> tuple[float, ...]:
        """See :class:`PointSpread`."""
        return tuple(BAND * math.sqrt(float(v)) for v in self._covariance(direction).inverse().diagonal())


@dataclass(frozen=True)
class SectorPointSpread:
    """Gaussian envelope of beams from an apex, as wide across in proportion to the depth.

    Args:
        axial: m, full width at half amplitude (two-way) along the beam.
        lateral: m, the same across the beam at ``depth``.
        depth: m, from the apex.
    """

    axial: float = 0.5e-3
    lateral: float = 1.2e-3
    depth: float = 50e-3

    def __post_init__(self) -> None:
        if not (math.isfinite(self.depth) and self.depth > 0):
            raise ValueError(f"depth must be positive and finite, got {self.depth!r}")
        self.in_beam_coordinates()

    def in_beam_coordinates(self) -> GaussianPointSpread:
        """The same in direction cosines across and metres along."""
        return GaussianPointSpread(self.axial, self.lateral / self.depth)


@dataclass(frozen=True, eq=False)
class SampledPointSpread:
    """A point-spread function given as an array.

    The array is scaled to a peak of 1. Its middle node (shape // 2) is the scatterer's position, and its axes
    are those of the image: the beam's direction does not turn it. The samples must resolve the function (|h|
    small at the Nyquist frequency).

    Args:
        values: (*shape), complex baseband samples.
        spacing: (D,), m, between samples, in the order x, y, z.
    """

    values: Tensor
    spacing: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.values.dim() != len(self.spacing) or not all(step > 0 for step in self.spacing):
            raise ValueError(f"a {self.values.dim()}-D point spread cannot have spacing {self.spacing!r}")
        if not torch.isfinite(torch.view_as_real(self.values.to(torch.complex64))).all():
            raise ValueError("the point-spread array holds NaN or infinity")
        if not self.values.abs().max() > 0:
            raise ValueError("the point-spread array holds nothing but zeros")
        object.__setattr__(self, "values", self.values / self.values.abs().max())

    def transform(self, wavenumbers: list[Tensor], direction: tuple[float, ...]) -> Tensor:
        """See :class:`PointSpread`."""
        total = self.values.to(torch.complex128)
        for axis in range(len(self.spacing)):  # one small dense transform per axis, x last in the array
            nodes = self.values.shape[-1 - axis]
            place = (torch.arange(nodes, dtype=torch.float64) - nodes // 2) * self.spacing[axis]
            wave = wavenumbers[axis].reshape(-1).double().cpu()
            phase = torch.exp(-1j * wave[:, None] * place).to(total) * self.spacing[axis]
            array_axis = total.dim() - 1 - axis
            total = torch.tensordot(phase, total, dims=([1], [array_axis])).movedim(0, array_axis)
        like = wavenumbers[0]
        return total.to(device=like.device, dtype=like.dtype.to_complex())

    def energy(self, dimension: int) -> float:
        """See :class:`PointSpread`."""
        return float(self.values.abs().double().square().sum()) * math.prod(self.spacing)

    def reach(self, direction: tuple[float, ...]) -> tuple[float, ...]:
        """See :class:`PointSpread`."""
        return tuple(0.5 * n * s for n, s in zip(reversed(self.values.shape), self.spacing, strict=True))

    def band(self, direction: tuple[float, ...]) -> tuple[float, ...]:
        """See :class:`PointSpread`."""
        return tuple(math.pi / step for step in self.spacing)
