"""Normalised cross-correlation of small kernels between images of a packet, for many points at once.

Kernels of all points of a tile are gathered into a layout in which the sum over images and one space axis
is a matrix product, so that the search runs at the speed of a batched matrix multiplication. Two axes of
lags come from slices of the gathered search regions and the third from the diagonals of the products.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor


@dataclass(frozen=True)
class KernelShape:
    """Half widths of a kernel and of the lags searched, both per array axis (z, y, x), in nodes."""

    half: tuple[int, int, int]
    search: tuple[int, int, int]

    @property
    def size(self) -> tuple[int, int, int]:
        return tuple(2 * h + 1 for h in self.half)

    @property
    def lags(self) -> tuple[int, int, int]:
        return tuple(2 * s + 1 for s in self.search)

    @property
    def region(self) -> tuple[int, int, int]:
        return tuple(2 * (h + s) + 1 for h, s in zip(self.half, self.search, strict=True))


def power(samples: Tensor) -> Tensor:
    """|samples|^2 of complex samples, without the square root that ``abs`` takes (several times faster)."""
    parts = torch.view_as_real(samples)
    return torch.addcmul(parts[..., 0].square(), parts[..., 1], parts[..., 1])


def gather(volume: Tensor, corner: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Blocks (sz, P, sy, sx, T) of ``volume`` (Z, Y, X, T) whose first nodes are ``corner`` (P, 3), array
    order.

    Whole lines of nodes and images are copied at once: the last two axes of the volume are contiguous.
    """
    depth, height, width, images = volume.shape
    lines = volume.as_strided(
        (depth * height, width - size[2] + 1, size[2] * images), (width * images, images, 1)
    )
    device = volume.device
    z = corner[None, :, 0, None] + torch.arange(size[0], device=device)[:, None, None]
    y = corner[None, :, 1, None] + torch.arange(size[1], device=device)
    blocks = lines[z * height + y, corner[None, :, 2, None].expand(*z.shape[:2], size[1])]
    return blocks.view(size[0], len(corner), size[1], size[2], images)


def correlate(
    volume: Tensor,
    corner: Tensor,
    offset: Tensor,
    apart: int,
    shape: KernelShape,
    *,
    ramp: Tensor | None = None,
) -> Tensor:
    """Normalised complex correlation (P, Lz, Ly, Lx) of images ``apart`` images from each other, pooled
    over pairs.

    ``volume`` (Z, Y, X, T) complex. ``corner`` (P, 3): first node of each kernel; ``offset`` (P, 3): lag
    in the middle of the search, nodes. With a(t, k) the kernel and b(t + apart, k + s) what lies at lag s,

        rho(s) = sum conj(a) b / sqrt(sum |a|^2 sum |b|^2),  sums over t and k,

    so |rho| <= 1. Zero where either has no energy. The caller pads the volume so that all blocks fit.
    ``ramp`` (P, 3), rad per node and image: how the echoes' turn between images changes along each axis; a
    kernel's nodes are turned back to its middle by it, so that axial shear does not make their products
    cancel.
    """
    kernel = gather(volume, corner, shape.size)[..., :-apart]
    if ramp is not None:
        kernel = kernel * _ramp_phasors(ramp * apart, shape)
    region = gather(volume, corner + offset - corner.new_tensor(shape.search), shape.region)[..., apart:]
    product = _lag_products(kernel, region, shape)
    kernel_energy = power(kernel).sum((0, 2, 3, 4))
    energy = power(region).sum(-1).transpose(0, 1)
    region_energy = F.avg_pool3d(energy[:, None], shape.size, stride=1)[:, 0] * float(
        torch.tensor(shape.size).prod()
    )
    norm = (kernel_energy[:, None, None, None] * region_energy).sqrt()
    tiny = torch.finfo(norm.dtype).tiny ** 0.5
    return torch.where(norm > tiny, product / norm.clamp_min(tiny), 0)


def _ramp_phasors(ramp: Tensor, shape: KernelShape) -> Tensor:
    """exp(i ramp . node) over a kernel, (kz, P, ky, kx, 1), nodes counted from its middle."""
    phase = torch.zeros((), dtype=ramp.dtype, device=ramp.device)
    for axis, view in enumerate(((-1, 1, 1, 1, 1), (1, 1, -1, 1, 1), (1, 1, 1, -1, 1))):
        node = torch.arange(-shape.half[axis], shape.half[axis] + 1, dtype=ramp.dtype, device=ramp.device)
        phase = phase + node.view(view) * ramp[:, axis].view(1, -1, 1, 1, 1)
    return torch.polar(torch.ones_like(phase), phase)


def _lag_products(kernel: Tensor, region: Tensor, shape: KernelShape) -> Tensor:
    """Sum over images and nodes of conj(kernel) region at every lag, (P, Lz, Ly, Lx) complex.

    kernel (kz, P, ky, kx, T), region (rz, P, ry, rx, T). Real and imaginary parts come from one product
    with the interleaved samples of the kernel and of i times the kernel.
    """
    (kz, ky, kx), (lz, ly, lx), (rz, ry, rx) = shape.size, shape.lags, shape.region
    points, images = kernel.shape[1], kernel.shape[-1]
    rows = torch.stack([torch.view_as_real(kernel), torch.view_as_real(1j * kernel)], 2)
    rows = rows.reshape(kz * points, 2 * ky, kx * images * 2)
    columns = torch.view_as_real(region).reshape(rz, points, ry, rx * images * 2)
    result = rows.new_zeros(points, lz, ly, lx, 2)
    for z in range(lz):
        slab = columns[z : z + kz].reshape(kz * points, ry, rx * images * 2)
        for x in range(lx):
            window = slab[:, :, x * images * 2 : (x + kx) * images * 2]
            gram = torch.bmm(rows, window.transpose(1, 2)).view(kz, points, 2, ky, ry).sum(0)
            # lag y of kernel row k is region row k + y: a diagonal of the product
            band = gram.as_strided((points, 2, ly, ky), (2 * ky * ry, ky * ry, 1, ry + 1))
            result[:, z, :, x] = band.sum(-1).transpose(1, 2)
    return torch.view_as_complex(result)
