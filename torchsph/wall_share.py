"""The part of a particle's kernel that lies in the fluid, and its gradient, from a signed distance on a grid."""

from __future__ import annotations

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional

from .smoothing import SmoothingKernel


class KernelShare:
    """Integral of the kernel over the fluid, and its gradient, at every node of a grid.

    The fluid's indicator, smoothed over one cell as a plane wall would be, is convolved with the kernel and with its
    gradient; edges, gaps and curvature are therefore contained (Ferrand et al. 2013 evaluate the same integrals face
    by face).

    Args:
        shape: of the grid. step: node spacing, in the unit of ``smoothing_length``.
        dtype: of the transforms; float32 leaves 1e-6 of the share.
    """

    def __init__(
        self, shape: tuple[int, ...], step: float, kernel: SmoothingKernel, smoothing_length: float, dtype: torch.dtype
    ) -> None:
        self.shape, self.step, self.dtype = tuple(shape), step, dtype
        filters = _filters(len(shape), step, kernel, smoothing_length)
        self._reach = filters.shape[1] // 2
        self._axes = tuple(range(1, len(shape) + 1))
        self._size = tuple(next_fast_len(n + 2 * self._reach, real=True) for n in shape)
        self._transforms = torch.fft.rfftn(filters.to(dtype), s=self._size, dim=self._axes)

    def at(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Share (1, *shape) in [0, 1] and its gradient (D, *shape), components x, y, z.

        ``distance`` (*shape): signed, positive in the fluid, in the unit of the step; beyond the grid it continues.
        """
        indicator = (0.5 + distance.to(self.dtype) / self.step).clamp(0.0, 1.0)
        padded = functional.pad(indicator[None, None], (self._reach,) * (2 * indicator.ndim), mode="replicate")[0]
        spectrum = torch.fft.rfftn(padded, s=self._size, dim=self._axes)
        inner = (0, *(slice(2 * self._reach, 2 * self._reach + n) for n in self.shape))
        # one filter at a time: all at once are too large for the processor's cache
        share, *gradient = (
            torch.fft.irfftn(spectrum * one, s=self._size, dim=self._axes)[inner] for one in self._transforms
        )
        return share[None].clamp(0.0, 1.0), torch.stack(gradient)


def _filters(dimension: int, step: float, kernel: SmoothingKernel, smoothing_length: float) -> Tensor:
    """The kernel and its gradient on the nodes around one, (1 + D, *k) float64."""
    reach = int(np.ceil(kernel.support * smoothing_length / step))
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64) * step
    mesh = torch.stack(torch.meshgrid(*[axis] * dimension, indexing="ij"))
    radius = mesh.norm(dim=0)
    weight = kernel.value(radius, smoothing_length, dimension)
    slope = kernel.gradient_factor(radius, smoothing_length, dimension) * mesh
    # discrete normalisation: a full neighbourhood has share 1, a linear indicator the right slope
    weight = weight / weight.sum()
    slope = slope / -(slope[0] * mesh[0]).sum()
    # the gradient of the share at x is the sum over y of grad W(x - y): odd in the offset x - y
    return _sharpened(torch.cat([weight[None], slope.flip(0)]))


def _sharpened(filters: Tensor) -> Tensor:
    """(1 - laplacian / 24) of filters (F, *k), one node larger: undoes the cell-wide smoothing of the indicator.

    A box of one cell passes the wave number k with 1 - k^2 / 24 + ... (k per node), whatever the wall's direction.
    """
    dimension = filters.ndim - 1
    wide = functional.pad(filters, (1,) * (2 * dimension))
    laplacian = -2.0 * dimension * wide
    for axis in range(1, dimension + 1):
        laplacian = laplacian + wide.roll(1, axis) + wide.roll(-1, axis)
    return wide - laplacian / 24.0
