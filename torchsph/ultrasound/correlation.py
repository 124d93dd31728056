"""Normalised cross-correlation of small kernels between images of a packet, for many points at once.

The sums over images and over two axes of the kernel are matrix products: one of kernel rows by region rows
for every node along the slowest axis and every lag along the fastest, so that the search runs at the speed of
a batched matrix multiplication. Lags of the slowest axis are further columns of a product, those of the
middle axis its diagonals. What the products are normalised by comes from running sums over the whole image.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .fields import box_sum


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


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """A packet ``volume`` (Z, Y, X, T) whose images are compared ``apart`` images from each other.

    first, second (Z, Y, X): sum of |sample|^2 over the kernel around each node and over the first and the
    second images of the pairs. The volume must be contiguous, with ``search`` and ``half`` nodes to spare
    around every kernel and lag, and T > apart.
    """

    volume: Tensor
    apart: int
    first: Tensor
    second: Tensor


def image_pairs(volume: Tensor, apart: int, half: tuple[int, int, int]) -> ImagePairs:
    """Pairs of images ``apart`` images from each other, for kernels of ``half`` widths in nodes."""
    if not 0 < apart < volume.shape[-1]:
        raise ValueError(f"images {apart} apart cannot be compared in a packet of {volume.shape[-1]}")
    parts = torch.view_as_real(volume)
    energies = []
    for images in (parts[..., :-apart, :], parts[..., apart:, :]):
        energy = torch.linalg.vector_norm(images, dim=(-2, -1)).square()
        for axis, h in enumerate(half):
            energy = box_sum(energy, 2 * h + 1, axis)
        energies.append(energy)
    return ImagePairs(volume, apart, *energies)


def gather(volume: Tensor, corner: Tensor, size: tuple[int, int, int], *, early: int = 0) -> Tensor:
    """Blocks (P, sz, sy, sx * T) of a contiguous ``volume`` (Z, Y, X, T) with first nodes ``corner`` (P, 3).

    Whole lines of nodes and images are copied at once. They are read ``early`` samples early: image t then
    stands in the place of image t + early, and the first ``early`` places of each node hold no image of its
    own. No corner may then be the very first node.
    """
    depth, height, width, images = volume.shape
    skipped = 1 if early else 0
    lines = volume.as_strided(
        (depth * height * width - size[2] + 1 - skipped, size[2] * images), (images, 1),
        volume.storage_offset() + skipped * images - early,
    )  # fmt: skip
    z = corner[:, 0, None, None] + torch.arange(size[0], device=corner.device)[:, None]
    y = corner[:, 1, None, None] + torch.arange(size[1], device=corner.device)
    first = (z * height + y) * width + corner[:, 2, None, None] - skipped
    # index_select copies line by line, ten times faster here than indexing
    return torch.index_select(lines, 0, first.reshape(-1)).view(*first.shape, size[2] * images)


def correlate(
    pairs: ImagePairs, corner: Tensor, offset: Tensor, shape: KernelShape, *, ramp: Tensor | None = None
) -> Tensor:
    """Normalised complex correlation (P, Lz, Ly, Lx), pooled over all pairs of images.

    ``corner`` (P, 3): first node of each kernel; ``offset`` (P, 3): lag in the middle of the search, nodes.
    With a(t, k) the kernel and b(t + apart, k + s) what lies at lag s,

        rho(s) = sum conj(a) b / sqrt(sum |a|^2 sum |b|^2),  sums over t and k,

    so |rho| <= 1. Zero where either has no energy.
    ``ramp`` (P, 3), rad per node and image: how the echoes' turn between images changes along each axis; a
    kernel's nodes are turned back to its middle by it, so that axial shear does not make their products
    cancel.
    """
    images = pairs.volume.shape[-1]
    # read early by as many images as the pairs are apart, the kernel lies opposite to what it is compared with
    kernel = gather(pairs.volume, corner, shape.size, early=pairs.apart)
    kernel = kernel.view(*kernel.shape[:3], shape.size[2], images)
    kernel[..., : pairs.apart] = 0
    kernel = kernel.conj() * _ramp_phasors(-ramp * pairs.apart, shape) if ramp is not None else kernel.conj()
    start = corner + offset - corner.new_tensor(shape.search)
    product = _lag_products(kernel.flatten(3), gather(pairs.volume, start, shape.region), shape, images)
    middle = corner.new_tensor(shape.half)
    first = gather(pairs.first[..., None], corner + middle, (1, 1, 1))
    second = gather(pairs.second[..., None], start + middle, shape.lags)
    norm = (first * second).sqrt()
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
