"""The part of a particle's kernel that lies in the fluid, and its gradient, from a signed distance on a grid."""

from __future__ import annotations

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional

from torchsph.pairs.smoothing_kernels import SmoothingKernel

# the slope of the distance is 1 but for nodes whose neighbours are nearest to different walls
_PLAIN = 0.97


class KernelCompleteness:
    """Integral of the kernel over the fluid, and its gradient, at every node of a grid.

    The fluid's indicator, smoothed over one cell as a plane wall would be, is convolved with the kernel and with its
    gradient; edges, gaps and curvature are therefore contained (Ferrand et al. 2013 evaluate the same integrals face
    by face). The nodes' values are such that multilinear interpolation between them is right on the average.

    Args:
        shape: of the grid.
        step: node spacing, in the unit of ``smoothing_length``.
        kernel: of the pair sums.
        smoothing_length: h.
        dtype: of the transforms; float32 leaves 1e-6 of the completeness.
        device: where the distances are.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        step: float,
        kernel: SmoothingKernel,
        smoothing_length: float,
        dtype: torch.dtype,
        device: str | torch.device = "cpu",
    ) -> None:
        self.shape, self.step, self.dtype = tuple(shape), step, dtype
        filters = _filters(len(shape), step, kernel, smoothing_length)
        self._reach = filters.shape[1] // 2
        self._axes = tuple(range(1, len(shape) + 1))
        self._size = tuple(next_fast_len(n + 2 * self._reach, real=True) for n in shape)
        self._transforms = torch.fft.rfftn(filters.to(device=device, dtype=dtype), s=self._size, dim=self._axes)

    def at(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Completeness (1, *shape) in [0, 1] and its gradient (D, *shape), components x, y, z.

        Args:
            distance: (*shape), signed, positive in the fluid, in the unit of the step; beyond the grid it continues.
        """
        spectrum = self._spectrum(self._indicator(distance))
        # one filter at a time: all at once are too large for the processor's cache
        completeness, *gradient = (self._back(spectrum * transform) for transform in self._transforms)
        return completeness[None].clamp(0.0, 1.0), torch.stack(gradient)

    def swept(self, distance: Tensor, speed: Tensor, normal: Tensor) -> Tensor:
        """Integral of the kernel times the wall's normal speed over its surface.

        Within 1 % in total; smeared a little wider than the completeness's gradient, by up to 7 % of the peak.
        Nodes that lie between two walls at an edge are left out: their normal belongs to neither of them.

        Args:
            distance: (*shape), signed, positive in the fluid, in the unit of the step.
            speed: (*shape), of the nearest wall point along ``normal``.
            normal: (D, *shape), unit, into the fluid.

        Returns:
            (1, *shape).
        """
        slope = torch.stack(torch.gradient(self._indicator(distance))[::-1]) / self.step
        plain = torch.stack(torch.gradient(distance)).norm(dim=0) > _PLAIN * self.step
        flux = torch.where(plain, speed * (normal * slope).sum(0), torch.zeros_like(speed))
        return self._back(self._spectrum(flux) * self._transforms[0])[None]

    def _indicator(self, distance: Tensor) -> Tensor:
        return (0.5 + distance.to(self.dtype) / self.step).clamp(0.0, 1.0)

    def _spectrum(self, field: Tensor) -> Tensor:
        """Transform of (*shape), continued beyond the grid."""
        padded = functional.pad(field[None, None], (self._reach,) * (2 * field.ndim), mode="replicate")[0]
        return torch.fft.rfftn(padded, s=self._size, dim=self._axes)

    def _back(self, spectrum: Tensor) -> Tensor:
        grid = (0, *(slice(2 * self._reach, 2 * self._reach + n) for n in self.shape))
        return torch.fft.irfftn(spectrum, s=self._size, dim=self._axes)[grid]


def _filters(dimension: int, step: float, kernel: SmoothingKernel, smoothing_length: float) -> Tensor:
    """The kernel and its gradient on the nodes around one, (1 + D, *k) float64."""
    reach = int(np.ceil(kernel.support * smoothing_length / step))
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64) * step
    mesh = torch.stack(torch.meshgrid(*[axis] * dimension, indexing="ij"))
    radius = mesh.norm(dim=0)
    weight = kernel.value(radius, smoothing_length, dimension)
    slope = kernel.gradient_factor(radius, smoothing_length, dimension) * mesh
    # discrete normalisation: a full neighbourhood has completeness 1, a linear indicator the right slope
    weight = weight / weight.sum()
    slope = slope / -(slope[0] * mesh[0]).sum()
    # the gradient of the completeness at x is the sum over y of grad W(x - y): odd in the offset x - y
    return _sharpened(torch.cat([weight[None], slope.flip(0)]))


def _sharpened(filters: Tensor) -> Tensor:
    """(1 - laplacian / 8) of filters (F, *k), one node larger: undoes what smooths the look-up.

    A box of one cell, the indicator's cut, passes the wave number k (per node) with 1 - k^2 / 24 + ..., whatever the
    wall's direction; multilinear interpolation passes it with 1 - k^2 / 12 + ... on the average over the cell.
    """
    dimension = filters.ndim - 1
    wide = functional.pad(filters, (1,) * (2 * dimension))
    laplacian = -2.0 * dimension * wide
    for axis in range(1, dimension + 1):
        laplacian = laplacian + wide.roll(1, axis) + wide.roll(-1, axis)
    return wide - laplacian / 8.0
