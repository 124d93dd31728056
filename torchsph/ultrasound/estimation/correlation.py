"""Normalised cross-correlation of small kernels between images of a packet, for many points at once, by torch.

The sums over images and over two axes of the kernel are matrix products: one of kernel rows by region rows
for every node along the slowest axis and every lag along the fastest, so that the search runs at the speed of
a batched matrix multiplication. Lags of the slowest axis are further columns of a product, those of the
middle axis its diagonals. This is what the compiled sums of ``csrc/correlation.cpp`` are held against.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from .box_sums import power

REGION_BYTES = 8 << 20  # of what is searched, gathered at a time: it bounds memory and stays in a CPU's cache

Triple = tuple[int, int, int]  # one whole number for each array axis z, y, x


def triple(numbers: Iterable[int]) -> Triple:
    """Three whole numbers, one for each array axis; ValueError where there are not three."""
    z, y, x = numbers
    return z, y, x


@dataclass(frozen=True)
class KernelShape:
    """Kernels and the lags that are searched, in nodes.

    Args:
        half: (3,), half widths of a kernel.
        search: (3,), greatest lags.
    """

    half: Triple
    search: Triple

    @property
    def size(self) -> Triple:
        """Nodes (3,) of a kernel."""
        return triple(2 * h + 1 for h in self.half)

    @property
    def lags(self) -> Triple:
        """How many lags (3,) are searched."""
        return triple(2 * s + 1 for s in self.search)

    @property
    def region(self) -> Triple:
        """Nodes (3,) that a kernel covers at all its lags together."""
        return triple(2 * (h + s) + 1 for h, s in zip(self.half, self.search, strict=True))


def check_apart(apart: int, images: int) -> None:
    """ValueError where a packet of ``images`` holds no two that are ``apart`` images apart."""
    if not 0 < apart < images:
        raise ValueError(f"images {apart} apart cannot be compared in a packet of {images}")


def gather(volume: Tensor, corner: Tensor, size: Triple, *, early: int = 0) -> Tensor:
    """Blocks (P, sz, sy, sx * T) of a volume; whole lines of nodes and images are copied at once.

    Args:
        volume: (Z, Y, X, T), contiguous.
        corner: (P, 3), first nodes of the blocks.
        size: (3,), nodes of a block.
        early: samples by which lines are read early: image t then stands in the place of image t + early, and
            the first ``early`` places of each node hold no image of its own. No corner may then be the very
            first node.
    """
    depth, height, width, images = volume.shape
    skipped = 1 if early else 0
    lines = volume.as_strided(
        (depth * height * width - size[2] + 1 - skipped, size[2] * images),
        (images, 1),
        volume.storage_offset() + skipped * images - early,
    )
    z = corner[:, 0, None, None] + torch.arange(size[0], device=corner.device)[:, None]
    y = corner[:, 1, None, None] + torch.arange(size[1], device=corner.device)
    first = (z * height + y) * width + corner[:, 2, None, None] - skipped
    # index_select copies line by line, ten times faster here than indexing
    return torch.index_select(lines, 0, first.reshape(-1)).view(*first.shape, size[2] * images)


def correlate(
    volume: Tensor, apart: int, corner: Tensor, offset: Tensor, shape: KernelShape, *, ramp: Tensor | None = None
) -> Tensor:
    """Normalised complex correlation (P, Lz, Ly, Lx), pooled over all pairs of images ``apart`` images apart.

    With a(t, k) the kernel and b(t + apart, k + s) what lies at lag s,

        rho(s) = sum conj(a) b / sqrt(sum |a|^2 sum |b|^2),  sums over t and k,

    so |rho| <= 1. Zero where either has no energy.

    Args:
        volume: (Z, Y, X, T), contiguous, with a node to spare around every kernel and lag, T > apart.
        apart: images between those compared.
        corner: (P, 3), first node of each kernel.
        offset: (P, 3), nodes, lag in the middle of the search.
        shape: of kernels and search.
        ramp: (P, 3), rad per node and image, how the echoes' turn between images changes along each axis; a
            kernel's nodes are turned back to its middle by it, so that axial shear does not make their products
            cancel.
    """
    check_apart(apart, volume.shape[-1])
    each = math.prod(shape.region) * volume.shape[-1] * volume.element_size()
    starts = range(0, max(len(corner), 1), max(REGION_BYTES // each, 1))
    parts = [slice(start, start + starts.step) for start in starts]
    ramps = [None if ramp is None else ramp[part] for part in parts]
    return torch.cat(
        [
            _correlate(volume, apart, corner[part], offset[part], shape, turn)
            for part, turn in zip(parts, ramps, strict=True)
        ]
    )


def _correlate(
    volume: Tensor, apart: int, corner: Tensor, offset: Tensor, shape: KernelShape, ramp: Tensor | None
) -> Tensor:
    images = volume.shape[-1]
    # read early by as many images as the pairs are apart, the kernel lies opposite to what it is compared with
    kernel = gather(volume, corner, shape.size, early=apart)
    kernel = kernel.view(*kernel.shape[:3], shape.size[2], images)
    kernel[..., :apart] = 0
    kernel = kernel.conj() * _ramp_phasors(-ramp * apart, shape) if ramp is not None else kernel.conj()
    region = gather(volume, corner + offset - corner.new_tensor(shape.search), shape.region)
    product = _lag_products(kernel.flatten(3), region, shape, images)
    first = power(kernel).flatten(1).sum(1)
    around = power(region.view(*region.shape[:3], shape.region[2], images)[..., apart:]).sum(-1)
    second = F.avg_pool3d(around[:, None], shape.size, stride=1, divisor_override=1)[:, 0]
    norm = first.sqrt()[:, None, None, None] * second.sqrt()
    tiny = torch.finfo(norm.dtype).tiny ** 0.5
    return torch.where(norm > tiny, product / norm.clamp_min(tiny), 0)


def _ramp_phasors(ramp: Tensor, shape: KernelShape) -> Tensor:
    """exp(i ramp . node) over a kernel, (P, kz, ky, kx, 1), nodes counted from its middle."""
    phase = torch.zeros((), dtype=ramp.dtype, device=ramp.device)
    for axis, view in enumerate(((1, -1, 1, 1, 1), (1, 1, -1, 1, 1), (1, 1, 1, -1, 1))):
        node = torch.arange(-shape.half[axis], shape.half[axis] + 1, dtype=ramp.dtype, device=ramp.device)
        phase = phase + node.view(view) * ramp[:, axis].view(-1, 1, 1, 1, 1)
    return torch.polar(torch.ones_like(phase), phase)


def _lag_products(kernel: Tensor, region: Tensor, shape: KernelShape, images: int) -> Tensor:
    """Sum over images and nodes of kernel times region at every lag, (P, Lz, Ly, Lx) complex.

    kernel (P, kz, ky, kx * T), conjugated already; region (P, rz, ry, rx * T).
    """
    (kz, ky, kx), (lz, ly, lx), (_, ry, _) = shape.size, shape.lags, shape.region
    points = len(kernel)
    kernel = kernel.resolve_conj()
    lines = region.flatten(1, 2)
    result = kernel.new_empty(points, lz, ly, lx)
    for x in range(lx):
        window = lines[..., x * images : (x + kx) * images].transpose(1, 2)
        product = torch.bmm(kernel[:, 0], window[..., : lz * ry])
        for z in range(1, kz):
            product.baddbmm_(kernel[:, z], window[..., z * ry : (z + lz) * ry])
        # lag y of kernel row k is region row k + y: a diagonal of the product
        diagonals = product.as_strided(
            (points, lz, ly, ky), (ky * lz * ry, ry, 1, lz * ry + 1), product.storage_offset()
        )
        result[..., x] = diagonals.sum(-1)
    return result
