"""Images of beams that fan out from an apex, whose point-spread function turns and widens with the place.

An aperture seen from far away has a pattern that depends on the difference of direction cosines alone. In the
coordinates (direction cosines, range) the point-spread function is therefore the same everywhere, and the
convolution in k-space applies; in metres it is turned along the beam, and as wide across as it is deep.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from geometry import Grid

from ..acquisition import Acquisition, Beams
from .convolution import Convolution
from .pointspread import SectorPointSpread


class SectorImager:
    """Forms images on a Cartesian grid from beams fanning out of an apex around their direction.

    Args:
        grid: the image grid.
        pointspread: how one scatterer looks, by depth.
        acquisition: the wave.
        beams: beams from an apex.
        width: nodes per axis that a scatterer is spread over, see :class:`Gridding`.
        dtype: precision of the samples' parts.
        device: where images are formed.

    Raises:
        ValueError: where the beams are parallel, or the grid reaches the apex or what lies behind it.
    """

    def __init__(
        self,
        grid: Grid,
        pointspread: SectorPointSpread,
        acquisition: Acquisition,
        beams: Beams,
        *,
        width: int = 4,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        if beams.apex is None:
            raise ValueError("SectorImager needs beams from an apex; use ParallelImager for parallel beams")
        self.grid, self.acquisition, self.beams, self._apex = grid, acquisition, beams, beams.apex
        nodes = grid.nodes(dtype=dtype).to(device)
        if bool((((nodes - nodes.new_tensor(self._apex)) @ nodes.new_tensor(beams.direction)) <= 0).any()):
            raise ValueError(f"the image grid reaches behind the apex {beams.apex!r} of the beams")
        self._nodes = self._coordinates(nodes)
        along = (0.0,) * (grid.dimension - 1) + (1.0,)
        shape = pointspread.in_beam_coordinates()
        reach = nodes.new_tensor(shape.reach(along))
        self._lower, self._upper = self._nodes.amin(0) - reach, self._nodes.amax(0) + reach
        sides = (self._upper - self._lower).tolist()
        self._convolution = Convolution(
            tuple(self._lower.tolist()), tuple(sides), shape, along, width=width, like=nodes
        )
        self.energy = (shape.energy(grid.dimension) * self._volume_element(self._nodes)).view(grid.shape)

    def _coordinates(self, points: Tensor) -> Tensor:
        """Direction cosines across and range, (n, D), of points (n, D), m."""
        away = points - points.new_tensor(self._apex)
        depth = away.norm(dim=1, keepdim=True)
        across = points.new_tensor(self.beams.across())
        return torch.cat([away @ across.T / depth, depth], 1)

    @staticmethod
    def _volume_element(coordinates: Tensor) -> Tensor:
        """m^D per unit of beam coordinates (n, D): range^(D - 1) over the cosine of the steering angle."""
        cosine = (1 - coordinates[:, :-1].square().sum(1)).sqrt()
        return coordinates[:, -1] ** (coordinates.shape[1] - 1) / cosine

    def image(self, points: Tensor, amplitude: Tensor) -> Tensor:
        """IQ (*shape) of scatterers: one of amplitude 1 gives h(b(x) - b(point)) exp(-i 4 pi f range / c).

        b are the beam coordinates.

        Args:
            points: (n, D), m.
            amplitude: (n,), complex.
        """
        place = self._coordinates(points)
        ahead = (points - points.new_tensor(self._apex)) @ points.new_tensor(self.beams.direction) > 0
        near = ((place >= self._lower) & (place <= self._upper)).all(1) & ahead
        place, amplitude = place[near], amplitude[near]
        # range from the nearest one keeps the phase small, and so exact in float32
        phase = -self.acquisition.phase_per_metre * (place[:, -1] - self._lower[-1])
        series = self._convolution.series(place, amplitude * torch.polar(torch.ones_like(phase), phase))
        common = -self.acquisition.phase_per_metre * float(self._lower[-1])
        return self._render(series) * complex(math.cos(common), math.sin(common))

    def noisy_image(
        self, points: Tensor, amplitude: Tensor, gain: Tensor, noise: float, generator: torch.Generator
    ) -> Tensor:
        """See :class:`Imager`."""
        image = self.image(points, amplitude) * gain
        return image.add_(self.noise(generator), alpha=math.sqrt(noise)) if noise else image

    def noise(self, generator: torch.Generator) -> Tensor:
        """Noise (*shape) of power 1, see :meth:`Convolution.noise`."""
        return self._render(self._convolution.noise(generator))

    def _render(self, series: Tensor) -> Tensor:
        """Evaluate a Fourier series (*lattice) at the grid's nodes."""
        field = torch.fft.ifftn(series / self._convolution.correction, norm="forward")
        return self._convolution.lattice.gather(field, self._nodes).view(self.grid.shape)
