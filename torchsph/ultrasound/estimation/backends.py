"""Who does the sums of speckle tracking: compiled code on the CPU, or torch anywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from torchsph.native.library import LibraryMissing, library

from .compiled import CompiledTracking
from .correlation import KernelShape, Triple
from .reference import ReferenceTracking

NAMES = ("auto", "cpu", "reference")


class TrackingBackend(Protocol):
    """Sums over images and over boxes of nodes; all per-axis numbers in array order z, y, x.

    Samples are finite, complex64 or complex128.
    """

    name: str

    def mean_power(self, images: Tensor) -> Tensor:
        """Mean square (z, y, x) over the images.

        Args:
            images: (T, z, y, x), complex.
        """
        ...

    def arrange(self, images: Tensor, margin: Triple, *, turns: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """Images side by side at every node, (Z, Y, X, T), with a rim of zero nodes, and what they are on average.

        Args:
            images: (T, z, y, x), complex.
            margin: (3,), nodes of the rim.
            turns: whether the autocorrelation is needed.

        Returns:
            The images; (Z, Y, X) their mean power; and with ``turns`` (Z, Y, X) their lag-one autocorrelation,
            the sum of each sample's conjugate times the sample of the next image, over the root of the power.
        """
        ...

    def box_sums(self, field: Tensor, middle: Tensor, half: Triple) -> Tensor:
        """Sums (P,) over boxes.

        Args:
            field: (Z, Y, X), real.
            middle: (P, 3), nodes in the middle of the boxes, which lie inside the volume.
            half: (3,), nodes, half widths of a box.
        """
        ...

    def sums_around(self, field: Tensor, half: Triple) -> Callable[[Tensor], Tensor]:
        """A function that gives the sums (P,) over the boxes around nodes (P, 3).

        Args:
            field: (Z, Y, X), complex; 0 outside.
            half: (3,), nodes, half widths of a box.
        """
        ...

    def correlate(
        self,
        volume: Tensor,
        apart: int,
        corner: Tensor,
        offset: Tensor,
        shape: KernelShape,
        *,
        ramp: Tensor | None = None,
    ) -> Tensor:
        """Normalised correlation (P, Lz, Ly, Lx), see :func:`torchsph.ultrasound.estimation.correlation.correlate`."""
        ...


def choose_backend(name: str = "auto", device: torch.device | str = "cpu") -> TrackingBackend:
    """The backend of a name.

    Args:
        name: "cpu" (compiled), "reference" (torch), or "auto": the first that is there.
        device: of the packet.

    Raises:
        ValueError: where the name is unknown, or "cpu" was asked for and cannot be used: nothing slower is
            taken silently in its place.
    """
    if name not in NAMES:
        raise ValueError(f"unknown tracking backend {name!r}; known: {', '.join(NAMES)}")
    if name == "reference":
        return ReferenceTracking()
    problem = None
    if torch.device(device).type != "cpu":
        problem = f"works on CPU tensors only, the packet is on '{device}'"
    else:
        try:
            library()
        except LibraryMissing as missing:
            problem = str(missing)
    if problem is None:
        return CompiledTracking()
    if name == "cpu":
        raise ValueError(f"tracking backend 'cpu' was asked for and cannot be used: {problem}")
    return ReferenceTracking()
