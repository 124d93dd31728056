"""What is finer than the measurement's own kernel: not in the data, and missing in the estimate and its members alike.

Members lie around the estimate at the scales that it has. How much a quantity would change with what is lost below them
nobody sees; but the estimate can be put through the measurement's kernel once more. Of an energy a second pass takes at
most what the first took: the integrals of E g^2 (1 - g^2) and of E (1 - g^2), g <= 1 the kernel's transfer. What it
takes is therefore the least that may be missing, near it where the estimate has won lost detail back. (A solution's own
error is judged by what it loses on a coarser grid in the same way: Roache 1994.) The flow that the walls alone drive is
known, and keeps all its detail.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import geometry
from geometry.grids.fields import fwhm_to_deviation, masked_blur

from ..measurement.wall_balance import WallBalance

__all__ = ["Resolution", "seen_again"]


class Resolution:
    """Puts estimates through the kernel of their measurement once more.

    Args:
        recording: whose grid and masks they have.
        balance: of mass between its walls, whose flow stays as it is; None: all of the flow is averaged.
        kernel: full width at half maximum (m) of the measurement's resolution; must be positive.

    Raises:
        ValueError: the kernel has no width.
    """

    def __init__(self, recording: geometry.Recording, balance: WallBalance | None, kernel: float) -> None:
        if not kernel > 0:
            raise ValueError(f"Resolution: the kernel must have a positive width (m), got {kernel}")
        self.recording, self.balance, self.deviation = recording, balance, fwhm_to_deviation(kernel)

    @classmethod
    def of(cls, recording: geometry.Recording, balance: WallBalance | None, kernel: float) -> Resolution | None:
        """None where a measurement shows no kernel."""
        return cls(recording, balance, kernel) if kernel > 0 else None

    def of_field(self, field: Tensor, frame: int) -> Tensor:
        """(D, *shape), m/s: an estimate (D, *shape) of a frame as it is seen once more."""
        if self.balance is None:
            return self._averaged(field, frame)
        known = torch.from_numpy(self.balance.known(frame)).to(field.dtype)
        return torch.where(self._mask(frame), known + self._averaged(field - known, frame), 0.0)

    def of_rate(self, rate: NDArray[np.floating], frame: int) -> NDArray[np.floating]:
        """(D, *shape), m/s^2: the same for du/dt, whose known part is not told apart."""
        return self._averaged(torch.from_numpy(rate), frame).numpy()

    def _averaged(self, field: Tensor, frame: int) -> Tensor:
        return masked_blur(field, self._mask(frame), self.deviation, tuple(self.recording.grid.spacing))

    def _mask(self, frame: int) -> Tensor:
        return torch.from_numpy(np.array(self.recording.mask[frame], bool))


def seen_again(
    resolution: Resolution | None, field: NDArray[np.floating], rate: NDArray[np.floating], frame: int
) -> tuple[NDArray[np.floating], NDArray[np.floating]] | tuple[None, None]:
    """An estimate and its du/dt (D, *shape) as the kernel shows them once more; nothing where no kernel is known."""
    if resolution is None:
        return None, None
    return resolution.of_field(torch.from_numpy(field), frame).numpy(), resolution.of_rate(rate, frame)
