"""Clutter filters: what separates blood from bright, slow tissue, along the images of a packet.

Overview and the response of regression filters: Bjaerum, Torp & Kristoffersen 2002. All filters act on IQ samples
(T, *shape) and keep only images that are free of transients. A further one is a class that meets
:class:`ClutterFilter` and an entry of ``CLUTTER_FILTERS``, by which options and tests find it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import torch
from scipy.signal import firwin
from torch import Tensor

IMAGES_AT_ONCE = 16  # that an FIR filter makes: more of them would multiply mostly by zeros


class ClutterFilter(Protocol):
    """A filter over the images of a packet, which stops what does not move.

    ``adaptive`` says whether what it removes depends on the data; else it is linear, and ``response`` and
    ``noise_gain`` are exact.
    """

    adaptive: ClassVar[bool]

    def apply(self, iq: Tensor) -> Tensor:
        """Filtered samples (T', *shape), T' <= T.

        Args:
            iq: (T, *shape), complex.

        Raises:
            ValueError: where the packet is too short for the filter.
        """
        ...

    def noise_gain(self, images: int) -> float:
        """Power that white noise keeps, mean over the images that come out."""
        ...

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Power response at ``frequency`` in units of the PRF."""
        ...


@dataclass(frozen=True)
class FIRFilter:
    """Linear-phase high-pass.

    A windowed design does not reject still tissue: firwin(9, .12) passes -5.9 dB at zero frequency. The
    mean of the coefficients is therefore taken off, which is the least change that puts an exact null
    there; being symmetric, the response then starts with the square of the frequency.

    Args:
        taps: number of coefficients, odd.
        cutoff: cut-off frequency, as a fraction of half the PRF.
    """

    adaptive: ClassVar[bool] = False

    taps: int = 9
    cutoff: float = 0.12

    def __post_init__(self) -> None:
        if self.taps < 3 or self.taps % 2 == 0:
            raise ValueError(f"taps must be an odd number >= 3, got {self.taps!r}")
        if not 0 < self.cutoff < 1:
            raise ValueError(f"cutoff must lie in (0, 1) of half the PRF, got {self.cutoff!r}")

    def coefficients(self) -> np.ndarray:
        """Coefficients (taps,), of unit gain at half the PRF.

        Raises:
            ArithmeticError: where their sum is not 0, so that still tissue would pass.
        """
        design = firwin(self.taps, self.cutoff, pass_zero=False)
        design = design - design.mean()
        design /= abs(np.sum(design * (-1.0) ** np.arange(self.taps)))
        if abs(design.sum()) > 1e-12:
            raise ArithmeticError(f"the clutter filter passes {abs(design.sum()):.1e} at zero frequency")
        return design

    def apply(self, iq: Tensor) -> Tensor:
        """See :class:`ClutterFilter`."""
        if len(iq) < self.taps:
            raise ValueError(f"an FIR filter of {self.taps} taps needs as many images, the packet has {len(iq)}")
        valid, parts = len(iq) - self.taps + 1, torch.view_as_real(iq.resolve_conj()).reshape(len(iq), -1)
        rows = min(valid, IMAGES_AT_ONCE)
        band, design = parts.new_zeros((rows, rows + self.taps - 1)), parts.new_tensor(self.coefficients())
        for row in range(rows):
            band[row, row : row + self.taps] = design  # symmetric, so convolution and correlation agree
        filtered = parts.new_empty((valid, parts.shape[1]))
        for first in range(0, valid, rows):  # products with a band matrix: one pass over memory, not one per tap
            last = min(first + rows, valid)
            some = band[: last - first, : last - first + self.taps - 1]
            torch.mm(some, parts[first : last + self.taps - 1], out=filtered[first:last])
        return torch.view_as_complex(filtered.view(valid, *iq.shape[1:], 2))

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """See :class:`ClutterFilter`."""
        phase = np.exp(-2j * np.pi * np.asarray(frequency)[:, None] * np.arange(self.taps))
        return np.abs(phase @ self.coefficients()) ** 2

    def noise_gain(self, images: int) -> float:
        """See :class:`ClutterFilter`."""
        return float((self.coefficients() ** 2).sum())


@dataclass(frozen=True)
class PolynomialFilter:
    """Removes from every sample's history its least-squares polynomial; keeps all images.

    Args:
        order: of the polynomial; 0 removes the mean.
    """

    adaptive: ClassVar[bool] = False

    order: int = 3

    def __post_init__(self) -> None:
        if isinstance(self.order, bool) or not isinstance(self.order, int) or self.order < 0:
            raise ValueError(f"order must be a whole number >= 0, got {self.order!r}")

    def _basis(self, images: int) -> np.ndarray:
        """Orthonormal polynomials (T, order + 1)."""
        if images <= self.order + 1:
            raise ValueError(f"a polynomial of order {self.order} leaves nothing of {images} images")
        return np.linalg.qr(np.vander(np.linspace(-1, 1, images), self.order + 1, increasing=True))[0]

    def apply(self, iq: Tensor) -> Tensor:
        """See :class:`ClutterFilter`."""
        basis = torch.from_numpy(self._basis(len(iq))).to(iq)
        flat = iq.reshape(len(iq), -1)
        return (flat - basis @ (basis.T @ flat)).reshape(iq.shape)

    def response(self, frequency: np.ndarray, images: int = 16) -> np.ndarray:
        """Mean power response over the packet (Bjaerum, Torp & Kristoffersen 2002).

        Args:
            frequency: (n,), in units of the PRF.
            images: of the packet.
        """
        wave = np.exp(2j * np.pi * np.asarray(frequency)[:, None] * np.arange(images))
        return 1 - (np.abs(wave.conj() @ self._basis(images)) ** 2).sum(1) / images

    def noise_gain(self, images: int) -> float:
        """See :class:`ClutterFilter`."""
        return 1 - (self.order + 1) / images


@dataclass(frozen=True)
class SVDFilter:
    """Removes the strongest components of space-time (Demene et al. 2015).

    Args:
        rank: how many of them.
    """

    adaptive: ClassVar[bool] = True

    rank: int = 2

    def __post_init__(self) -> None:
        if isinstance(self.rank, bool) or not isinstance(self.rank, int) or self.rank < 1:
            raise ValueError(f"rank must be a whole number >= 1, got {self.rank!r}")

    def apply(self, iq: Tensor) -> Tensor:
        """See :class:`ClutterFilter`."""
        if len(iq) <= self.rank:
            raise ValueError(f"removing {self.rank} components leaves nothing of {len(iq)} images")
        flat = iq.reshape(len(iq), -1)
        clean = torch.nan_to_num(flat)  # a NaN sample must not decide about the others
        gram = (clean @ clean.mH).to(torch.complex128)
        strongest = torch.linalg.eigh(gram).eigenvectors[:, -self.rank :].to(iq)
        return (flat - strongest @ (strongest.mH @ flat)).reshape(iq.shape)

    def noise_gain(self, images: int) -> float:
        """See :class:`ClutterFilter`."""
        return 1 - self.rank / images

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Ones: what is removed depends on the data."""
        return np.ones(np.shape(frequency))


CLUTTER_FILTERS: dict[str, Callable[[], ClutterFilter]] = {
    "fir": FIRFilter,
    "polynomial": PolynomialFilter,
    "svd": SVDFilter,
}
"""Filters by the names that options give them."""
