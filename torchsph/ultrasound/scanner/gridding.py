"""Points to a periodic lattice and back without aliasing: gridding with a compact kernel.

The non-uniform Fourier transform with the "exponential of semicircle" kernel of Barnett, Magland & af Klinteberg
2019. Each point is spread over a few nodes; dividing the lattice's
Fourier transform by the kernel's undoes the smearing. What remains is the aliased tail of the kernel:
about 1e-3 at four nodes and an oversampling of 1.5, falling some tenfold per node.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from torchsph.native.library import REALS, LibraryMissing, library
from torchsph.native.structures import GriddingArguments

CHUNK = 1 << 14  # points spread at a time: their stencils stay in the cache


@dataclass(frozen=True)
class Gridding:
    """A periodic lattice: node (k, j, i) at ``origin + spacing * (i, j, k)``, the box repeats after ``shape`` nodes.

    Args:
        origin: (D,), m, of node 0, in the order x, y, z.
        spacing: (D,), m, between nodes, in the order x, y, z.
        shape: (D,), nodes per axis, in the order of the array.
        width: nodes per axis that a point touches.
        oversampling: Nyquist frequency of the lattice over the highest frequency that has to be right.
    """

    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    shape: tuple[int, ...]
    width: int = 4
    oversampling: float = 1.5

    def __post_init__(self) -> None:
        if not 2 <= self.width <= 12:
            raise ValueError(f"width must be 2 to 12 nodes, got {self.width!r}")
        if not self.oversampling > 1:
            raise ValueError(f"oversampling must exceed 1, got {self.oversampling!r}")
        if min(self.shape) < self.width:
            raise ValueError(f"a lattice of {self.shape} nodes is smaller than the kernel's {self.width}")

    @property
    def shape_parameter(self) -> float:
        """Beta of the kernel exp(beta (sqrt(1 - z^2) - 1)) (Barnett, Magland & af Klinteberg 2019, sec. 3.2)."""
        return 0.97 * math.pi * self.width * (1 - 0.5 / self.oversampling)

    def spread(self, points: Tensor, values: Tensor) -> Tensor:
        """Add values to a lattice of zeros: (*shape).

        Complex ones by compiled code where there is some (0.4 million points in 3-D, one core: 30 ms), else by
        torch (175 ms).

        Args:
            points: (n, D), m.
            values: (n,), real or complex.
        """
        field = values.new_zeros(math.prod(self.shape))
        compiled = _compiled("spread", points, values)
        if compiled is not None:
            self._call(compiled, points, values.resolve_conj().contiguous(), field)
            return field.view(self.shape)
        for start in range(0, len(points), CHUNK):
            nodes, weights = self._stencil(points[start : start + CHUNK])
            field.index_add_(0, nodes.reshape(-1), (weights * values[start : start + CHUNK, None]).reshape(-1))
        return field.view(self.shape)

    def gather(self, field: Tensor, points: Tensor) -> Tensor:
        """Adjoint of :meth:`spread`: weighted sums (n,) of ``field`` (*shape) around ``points`` (n, D)."""
        compiled = _compiled("gather", points, field)
        if compiled is not None:
            values = field.new_empty(len(points))
            self._call(compiled, points, values, field.resolve_conj().contiguous())
            return values
        flat = field.reshape(-1)
        parts = []
        for start in range(0, len(points), CHUNK):
            nodes, weights = self._stencil(points[start : start + CHUNK])
            parts.append((flat[nodes] * weights).sum(1))
        return torch.cat(parts) if parts else flat.new_zeros(0)

    def _call(self, function: Callable[..., object], points: Tensor, values: Tensor, field: Tensor) -> None:
        points, triple, dimension = points.contiguous(), ctypes.c_double * 3, len(self.shape)
        function(
            ctypes.byref(
                GriddingArguments(
                    threads=torch.get_num_threads(),
                    dimension=dimension,
                    width=self.width,
                    shape_parameter=self.shape_parameter,
                    origin=triple(*self.origin),
                    spacing=triple(*self.spacing),
                    counts=(ctypes.c_int64 * 3)(*reversed(self.shape)),
                    points=len(points),
                    position=points.data_ptr(),
                    values=values.data_ptr(),
                    field=field.data_ptr(),
                )
            )
        )

    def wavenumbers(self, axis: int, like: Tensor) -> Tensor:
        """Angular wavenumbers (nodes,), rad/m, of the lattice's Fourier transform; axis 0 is x."""
        nodes, step = self.shape[-1 - axis], self.spacing[axis]
        return 2 * math.pi * torch.fft.fftfreq(nodes, step, dtype=like.dtype, device=like.device)

    def correction(self, axis: int, like: Tensor) -> Tensor:
        """Fourier transform (nodes,) of the kernel along an axis, to divide the lattice's by."""
        # to round-off up to Nyquist
        place, share = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(24 + 2 * self.width))
        half = 0.5 * self.width * self.wavenumbers(axis, place) * self.spacing[axis]
        integral = torch.cos(half[:, None] * place) @ (share * self._kernel(place))
        return (0.5 * self.width * integral).to(like)

    def _stencil(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Flat node numbers and weights, both (n, width ** D)."""
        dimension = len(self.shape)
        nodes = torch.zeros((len(points), 1), dtype=torch.long, device=points.device)
        weights = torch.ones((len(points), 1), dtype=points.dtype, device=points.device)
        for axis in reversed(range(dimension)):  # z first, so that x varies fastest
            place = (points[:, axis] - self.origin[axis]) / self.spacing[axis]
            first = torch.ceil(place - 0.5 * self.width)
            offset = torch.arange(self.width, device=points.device)
            distance = (first[:, None] + offset - place[:, None]) / (0.5 * self.width)
            weight = self._kernel(distance)
            node = (first.long()[:, None] + offset) % self.shape[-1 - axis]
            nodes = (nodes[:, :, None] * self.shape[-1 - axis] + node[:, None, :]).flatten(1)
            weights = (weights[:, :, None] * weight[:, None, :]).flatten(1)
        return nodes, weights

    def _kernel(self, distance: Tensor) -> Tensor:
        """The kernel at ``distance`` in half widths; zero beyond 1."""
        root = (1 - distance.square()).clamp_min(0).sqrt()
        return torch.where(distance.abs() <= 1, torch.exp(self.shape_parameter * (root - 1)), 0)


def _compiled(name: str, points: Tensor, samples: Tensor) -> Callable[..., object] | None:
    """Compiled sums for complex samples on the CPU; None where torch has to do."""
    derived = torch.is_grad_enabled() and (points.requires_grad or samples.requires_grad)
    known = points.dtype in REALS and samples.dtype == points.dtype.to_complex()
    if samples.device.type != "cpu" or not known or derived:
        return None
    try:
        function = library().function(name, REALS[points.dtype])
    except LibraryMissing:
        return None
    function.restype = None
    return function


def fast_length(least: int) -> int:
    """Smallest length >= ``least`` whose only prime factors are 2, 3 and 5, for quick Fourier transforms."""
    candidates = (2**a * 3**b * 5**c for a, b, c in product(range(25), range(16), range(11)))
    return min(length for length in candidates if length >= least)
