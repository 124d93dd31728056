"""The convolution of scatterers with a point-spread function in k-space, whatever the coordinates are."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .gridding import Gridding, fast_length
from .pointspread import PointSpread

OVERSAMPLING = 1.5


class Convolution:
    """Scatterers to the Fourier series of their image in a periodic box.

    The box must leave room for the reach of the point-spread function outside what is looked at.

    Args:
        origin: (D,), m, lowest corner of the box, in the order of the coordinates x, y, z.
        sides: (D,), m, of the box.
        pointspread: how one scatterer looks.
        direction: (D,), unit vector along the beams.
        width: nodes per axis that a scatterer is spread over, see :class:`Gridding`.
        like: a tensor of the precision and on the device to work in.
    """

    def __init__(
        self,
        origin: tuple[float, ...],
        sides: tuple[float, ...],
        pointspread: PointSpread,
        direction: tuple[float, ...],
        *,
        width: int,
        like: Tensor,
    ) -> None:
        nodes = [
            fast_length(max(math.ceil(OVERSAMPLING * band * side / math.pi), 2 * width))
            for band, side in zip(pointspread.band(direction), sides, strict=True)
        ]
        spacing = tuple(side / n for side, n in zip(sides, nodes, strict=True))
        self.lattice = Gridding(origin, spacing, tuple(reversed(nodes)), width, OVERSAMPLING)
        waves, self.correction = [], torch.ones((), dtype=like.dtype, device=like.device)
        for axis in range(len(sides)):
            view = [1] * len(sides)
            view[len(sides) - 1 - axis] = -1
            waves.append(self.lattice.wavenumbers(axis, like).view(view))
            self.correction = self.correction * self.lattice.correction(axis, like).view(view)
        transform = pointspread.transform(waves, direction)
        self._window = transform / (self.correction * math.prod(sides))
        self._colour = transform.abs() / transform.abs().square().sum().sqrt()

    def series(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """Fourier series (*lattice) of an image of scatterers.

        Args:
            points: (n, D), m, where the scatterers are.
            amplitude: (n,), complex.
        """
        return torch.fft.fftn(self.lattice.spread(points, amplitude)) * self._window

    def noise(self, generator: torch.Generator) -> Tensor:
        """Series of circular Gaussian noise of power 1 in the band of the point-spread function.

        White receiver noise that has gone through the same filter and beamformer as the echoes: the least
        favourable colour, since no further filter can separate the two.
        """
        like = self._colour
        white = torch.randn((*like.shape, 2), generator=generator, dtype=like.dtype, device=like.device)
        return torch.view_as_complex(white) * (like / math.sqrt(2))
