"""Scatterers to IQ images: a convolution with the point-spread function, done in k-space.

The idea of FUSK (Hergum et al. 2009): an image is the scatterers' Fourier transform times that of the point-spread
function. Single scattering, one speed of sound.
"""

from __future__ import annotations

import cmath
import math
from typing import Protocol

import torch
from torch import Tensor

from geometry import Grid

from ..acquisition import Acquisition, Beams
from .convolution import Convolution
from .gridding import fast_length
from .pointspread import PointSpread

PLANE_BYTES = 4 << 20  # of a transform's temporary arrays


class Imager(Protocol):
    """Forms images on a grid."""

    @property
    def energy(self) -> float | Tensor:
        """Integral of |h|^2, m^D, over the scatterers' positions, a number or one for each node (*shape).

        The power that one scatterer of power 1 per m^D gives on average.
        """
        ...

    def image(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """IQ (*shape) of scatterers, without noise.

        Args:
            points: (n, D), m.
            amplitude: (n,), complex.
        """
        ...

    def noisy_image(
        self, points: Tensor, amplitude: Tensor, gain: Tensor, noise: float, generator: torch.Generator
    ) -> Tensor:
        """:meth:`image` times a gain, in circular Gaussian noise in the band of the point-spread function.

        Args:
            points: (n, D), m.
            amplitude: (n,), complex.
            gain: in the shape of ``energy``.
            noise: power of the noise; 0 draws none.
            generator: draws the noise.
        """
        ...


class ParallelImager:
    """Forms images on ``grid`` with parallel beams and the same point-spread function everywhere.

    The box of the grid is enlarged by the reach of the point-spread function, so that the periodic Fourier
    transform wraps nothing into view; scatterers beyond that margin are left out.

    Args:
        grid: the image grid.
        pointspread: how one scatterer looks.
        acquisition: the wave.
        beams: parallel beams.
        width: nodes per axis that a scatterer is spread over, see :class:`Gridding`.
        dtype: precision of the samples' parts.
        device: where images are formed.

    Raises:
        ValueError: where the beams come from an apex.
    """

    def __init__(
        self,
        grid: Grid,
        pointspread: PointSpread,
        acquisition: Acquisition,
        beams: Beams,
        *,
        width: int = 4,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        if beams.apex is not None:
            raise ValueError("ParallelImager needs parallel beams; use SectorImager for beams from an apex")
        self.grid, self.acquisition, self.beams = grid, acquisition, beams
        self.energy = pointspread.energy(grid.dimension)
        reach = pointspread.reach(beams.direction)
        pad = [math.ceil(r / s) for r, s in zip(reach, grid.spacing, strict=True)]
        self._pad = tuple(reversed(pad))
        self._padded = tuple(fast_length(n + 2 * p) for n, p in zip(grid.shape, self._pad, strict=True))
        self._lower = torch.tensor(grid.origin, dtype=dtype, device=device)
        self._reach = torch.tensor(reach, dtype=dtype, device=device)
        self._upper = torch.tensor(grid.upper, dtype=dtype, device=device)
        self._convolution = Convolution(
            tuple(o - p * s for o, p, s in zip(grid.origin, pad, grid.spacing, strict=True)),
            tuple(n * s for n, s in zip(reversed(self._padded), grid.spacing, strict=True)),
            pointspread,
            beams.direction,
            width=width,
            like=self._lower,
        )

    def image(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """IQ (*shape) of scatterers: one of amplitude 1 gives h(x - point) exp(-i 4 pi f depth / c).

        Args:
            points: (n, D), m.
            amplitude: (n,), complex.
        """
        return self._render(self._series(points, amplitude))

    def noisy_image(
        self, points: Tensor, amplitude: Tensor, gain: Tensor, noise: float, generator: torch.Generator
    ) -> Tensor:
        """See :class:`Imager`; echoes and noise are one series, transformed once."""
        series = self._series(points, amplitude * gain)
        if noise:
            series += math.sqrt(noise) * self._convolution.noise(generator)
        return self._render(series)

    def noise(self, generator: torch.Generator) -> Tensor:
        """Noise (*shape) of power 1, see :meth:`Convolution.noise`."""
        return self._render(self._convolution.noise(generator))

    def _series(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """Fourier series (*lattice) of the scatterers' image."""
        near = ((points >= self._lower - self._reach) & (points <= self._upper + self._reach)).all(1)
        points, amplitude = points[near], amplitude[near]
        # depth from the grid's corner keeps the phase small, and so exact in float32; then one common factor
        phase = -self.acquisition.phase_per_metre * self.beams.depth(points - self._lower)
        series = self._convolution.series(points, amplitude * torch.polar(torch.ones_like(phase), phase))
        corner = sum(o * b for o, b in zip(self.grid.origin, self.beams.direction, strict=True))
        return series.mul_(cmath.exp(-1j * self.acquisition.phase_per_metre * corner))

    def _render(self, series: Tensor) -> Tensor:
        """Evaluate a Fourier series (*lattice) on the grid's nodes.

        Axis by axis, and only for the rows that are kept of the axes before: half the work of a transform of
        the whole padded box. The later axes a few planes at a time, which stay in the cache.
        """
        rows, image = self._along(series, 0), series.new_empty(self.grid.shape)
        planes = max(1, PLANE_BYTES // (math.prod(self._padded[1:]) * series.element_size()))
        for start in range(0, len(rows), planes):
            part = rows[start : start + planes]
            for axis in range(1, part.dim()):
                part = self._along(part, axis)
            image[start : start + planes] = part
        return image

    def _along(self, series: Tensor, axis: int) -> Tensor:
        """Evaluate a Fourier series along one axis, at the grid's nodes."""
        nodes = torch.fft.ifft(resize_spectrum(series, axis, self._padded[axis]), dim=axis, norm="forward")
        return nodes.narrow(axis, self._pad[axis], self.grid.shape[axis])


def resize_spectrum(spectrum: Tensor, axis: int, nodes: int) -> Tensor:
    """The same function on other nodes: a Fourier series zero-padded or cropped along an axis.

    Args:
        spectrum: of any shape, in FFT order along the axis.
        axis: which axis.
        nodes: terms that are to be left or made along it.
    """
    have = spectrum.shape[axis]
    keep = min(have, nodes)
    positive, negative = (keep + 1) // 2, (keep - 1) // 2  # an unpaired Nyquist term is dropped
    gap = list(spectrum.shape)
    gap[axis] = nodes - positive - negative
    return torch.cat(
        [
            spectrum.narrow(axis, 0, positive),
            spectrum.new_zeros(gap),
            spectrum.narrow(axis, have - negative, negative),
        ],
        axis,
    )
