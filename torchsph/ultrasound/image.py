"""Scatterers to IQ images: a convolution with the point-spread function, done in k-space.

The idea of FUSK (Hergum et al., IEEE Trans. Ultrason. Ferroelectr. Freq. Control 56, 2009): an image is the
scatterers' Fourier transform times that of the point-spread function. Single scattering, one speed of sound.
"""

from __future__ import annotations

import cmath
import math
from typing import Protocol

import torch
from torch import Tensor

from geometry import Grid

from .acquisition import Acquisition, Beams
from .convolution import Convolution
from .gridding import fast_length
from .pointspread import PointSpread


class Imager(Protocol):
    """Forms images on a grid.

    energy: integral of |h|^2, m^D, over the scatterers' positions, a number or one for each node: the power
    that one scatterer of power 1 per m^D gives on average.
    """

    energy: float | Tensor

    def image(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """IQ (*shape) of scatterers at ``points`` (n, D), m, with complex ``amplitude`` (n,)."""
        ...

    def noise(self, generator: torch.Generator) -> Tensor:
        """Circular Gaussian noise (*shape) of power 1 in the band of the point-spread function."""
        ...


class ParallelImager:
    """Forms images on ``grid`` with parallel beams and the same point-spread function everywhere.

    The box of the grid is enlarged by the reach of the point-spread function, so that the periodic Fourier
    transform wraps nothing into view; scatterers beyond that margin are left out.
    """

    def __init__(
        self, grid: Grid, pointspread: PointSpread, acquisition: Acquisition, beams: Beams,
        *, width: int = 4, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu",
    ) -> None:  # fmt: skip
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
            pointspread, beams.direction, width=width, like=self._lower,
        )  # fmt: skip

    def image(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """IQ (*shape) of scatterers at ``points`` (n, D), m, with complex ``amplitude`` (n,).

        A lone scatterer of amplitude 1 gives h(x - point) exp(-i 4 pi f depth / c).
        """
        near = ((points >= self._lower - self._reach) & (points <= self._upper + self._reach)).all(1)
        points, amplitude = points[near], amplitude[near]
        # depth from the grid's corner keeps the phase small, and so exact in float32; then one common factor
        phase = -self.acquisition.phase_per_metre * self.beams.depth(points - self._lower)
        series = self._convolution.series(points, amplitude * torch.polar(torch.ones_like(phase), phase))
        corner = sum(o * b for o, b in zip(self.grid.origin, self.beams.direction, strict=True))
        return self._render(series) * cmath.exp(-1j * self.acquisition.phase_per_metre * corner)

    def noise(self, generator: torch.Generator) -> Tensor:
        """Noise (*shape) of power 1, see :meth:`Convolution.noise`."""
        return self._render(self._convolution.noise(generator))

    def _render(self, series: Tensor) -> Tensor:
        """Evaluate a Fourier series (*lattice) on the grid's nodes."""
        image = torch.fft.ifftn(resize_spectrum(series, self._padded), norm="forward")
        for axis, (pad, nodes) in enumerate(zip(self._pad, self.grid.shape, strict=True)):
            image = image.narrow(axis, pad, nodes)
        return image.contiguous()


def resize_spectrum(spectrum: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Zero-pad or crop a Fourier series (in FFT order) to ``shape``: the same function on other nodes."""
    for axis, nodes in enumerate(shape):
        have = spectrum.shape[axis]
        keep = min(have, nodes)
        positive, negative = (keep + 1) // 2, (keep - 1) // 2  # an unpaired Nyquist term is dropped
        parts = [spectrum.narrow(axis, 0, positive)]
        gap = list(spectrum.shape)
        gap[axis] = nodes - positive - negative
        parts.append(spectrum.new_zeros(gap))
        parts.append(spectrum.narrow(axis, have - negative, negative))
        spectrum = torch.cat(parts, axis)
    return spectrum
