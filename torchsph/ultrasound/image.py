"""Scatterers to IQ images: a convolution with the point-spread function, done in k-space.

The idea of FUSK (Hergum et al., IEEE Trans. Ultrason. Ferroelectr. Freq. Control 56, 2009): an image is the
scatterers' Fourier transform times that of the point-spread function. Single scattering, one speed of sound.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from geometry import Grid

from .acquisition import Acquisition, Beams
from .gridding import Gridding, fast_length
from .pointspread import PointSpread

OVERSAMPLING = 1.5


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
        reach = pointspread.reach(beams.direction)
        pad = [math.ceil(r / s) for r, s in zip(reach, grid.spacing, strict=True)]
        self._pad = tuple(reversed(pad))
        self._padded = tuple(fast_length(n + 2 * p) for n, p in zip(grid.shape, self._pad, strict=True))
        box = [n * s for n, s in zip(reversed(self._padded), grid.spacing, strict=True)]
        nodes = [
            fast_length(max(math.ceil(OVERSAMPLING * band * length / math.pi), 2 * width))
            for band, length in zip(pointspread.band(beams.direction), box, strict=True)
        ]
        self.lattice = Gridding(
            tuple(o - p * s for o, p, s in zip(grid.origin, pad, grid.spacing, strict=True)),
            tuple(length / n for length, n in zip(box, nodes, strict=True)),
            tuple(reversed(nodes)), width, OVERSAMPLING,
        )  # fmt: skip
        self._lower = torch.tensor(grid.origin, dtype=dtype, device=device)
        self._reach = torch.tensor(reach, dtype=dtype, device=device)
        self._upper = torch.tensor(grid.upper, dtype=dtype, device=device)
        self._window, self._colour = self._make_windows(pointspread, math.prod(box))

    def _make_windows(self, pointspread: PointSpread, volume: float) -> tuple[Tensor, Tensor]:
        """Point-spread transform over the gridding kernel's, and the colour of noise of power 1."""
        dimension = self.grid.dimension
        waves, spread = [], torch.ones((), dtype=self._lower.dtype, device=self._lower.device)
        for axis in range(dimension):
            view = [1] * dimension
            view[dimension - 1 - axis] = -1
            waves.append(self.lattice.wavenumbers(axis, self._lower).view(view))
            spread = spread * self.lattice.correction(axis, self._lower).view(view)
        transform = pointspread.transform(waves, self.beams.direction)
        colour = transform.abs()
        return transform / (spread * volume), colour / colour.square().sum().sqrt()

    def image(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """IQ (*shape) of scatterers at ``points`` (n, D), m, with complex ``amplitude`` (n,).

        A lone scatterer of amplitude 1 gives h(x - point) exp(-i 4 pi f depth / c).
        """
        near = ((points >= self._lower - self._reach) & (points <= self._upper + self._reach)).all(1)
        points, amplitude = points[near], amplitude[near]
        # depth from the grid's corner keeps the phase small, and so exact in float32; then one common factor
        phase = -self.acquisition.phase_per_metre * self.beams.depth(points - self._lower)
        spectrum = torch.fft.fftn(
            self.lattice.spread(points, amplitude * torch.polar(torch.ones_like(phase), phase))
        )
        corner = sum(o * b for o, b in zip(self.grid.origin, self.beams.direction, strict=True))
        common = -self.acquisition.phase_per_metre * corner
        return self._render(spectrum * self._window) * complex(math.cos(common), math.sin(common))

    def noise(self, generator: torch.Generator) -> Tensor:
        """Circular Gaussian noise (*shape) of power 1 in the band of the point-spread function.

        White receiver noise that has gone through the same filter and beamformer as the echoes: the least
        favourable colour, since no further filter can separate the two.
        """
        like = self._colour
        white = torch.randn((*like.shape, 2), generator=generator, dtype=like.dtype, device=like.device)
        return self._render(torch.view_as_complex(white) * (like / math.sqrt(2)))

    def _render(self, spectrum: Tensor) -> Tensor:
        """Evaluate a Fourier series (*lattice) on the grid's nodes."""
        resized = resize_spectrum(spectrum, self._padded)
        image = torch.fft.ifftn(resized, norm="forward")
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
