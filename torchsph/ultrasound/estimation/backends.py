"""Who does the sums of speckle tracking: compiled code on the CPU, or torch anywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from torchsph.native.library import LibraryMissing, library

from .compiled import CompiledBackend
from .correlation import KernelShape
from .reference import TorchBackend

NAMES = ("auto", "cpu", "reference")


class Backend(Protocol):
    """Sums over images and over boxes of nodes; all per-axis numbers in array order z, y, x.

    Samples are finite, complex64 or complex128.
    """

    name: str

    def mean_power(self, images: Tensor) -> Tensor:
        """Mean square (z, y, x) over ``images`` (T, z, y, x)."""
        ...

    def arrange(
        self, images: Tensor, margin: tuple[int, int, int], *, turns: bool
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Images (T, z, y, x) side by side at every node, (Z, Y, X, T) with a rim of ``margin`` zero nodes.

        Also (Z, Y, X): their mean power, and with ``turns`` their lag-one autocorrelation, the sum of each
        sample's conjugate times the sample of the next image, over the root of the power.
        """
        ...

    def box_sums(self, field: Tensor, middle: Tensor, half: tuple[int, int, int]) -> Tensor:
        """Sums (P,) of a real ``field`` (Z, Y, X) over the boxes of ``half`` widths around ``middle`` (P, 3)."""
        ...

    def sums_around(self, field: Tensor, half: tuple[int, int, int]) -> Callable[[Tensor], Tensor]:
        """Sums (P,) of a complex ``field`` (Z, Y, X), 0 outside, over boxes of ``half`` widths around nodes (P, 3)."""
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
        """Normalised correlation (P, Lz, Ly, Lx), see :func:`torchsph.ultrasound.correlation.correlate`."""
        ...


def backend(name: str = "auto", device: torch.device | str = "cpu") -> Backend:
    """The backend called ``name``, "cpu" (compiled) or "reference" (torch); "auto": the first that is there.

    Raises ValueError where the name is unknown, or "cpu" was asked for and cannot be used: nothing slower is
    taken silently in its place.
    """
    if name not in NAMES:
        raise ValueError(f"unknown tracking backend {name!r}; known: {', '.join(NAMES)}")
    if name == "reference":
        return TorchBackend()
    problem = None
    if torch.device(device).type != "cpu":
        problem = f"works on CPU tensors only, the packet is on '{device}'"
    else:
        try:
            library()
        except LibraryMissing as missing:
            problem = str(missing)
    if problem is None:
        return CompiledBackend()
    if name == "cpu":
        raise ValueError(f"tracking backend 'cpu' was asked for and cannot be used: {problem}")
    return TorchBackend()
