"""The sums of speckle tracking in plain torch: any device, and what the compiled ones are held against."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from .box_sums import box_sum, power
from .correlation import KernelShape, Triple, correlate, gather, triple


class ReferenceTracking:
    """The sums by torch, see :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""

    name = "reference"

    def mean_power(self, images: Tensor) -> Tensor:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        total = power(images[0])
        for image in images[1:]:  # one at a time to spare memory
            total += power(image)
        return total / len(images)

    def arrange(self, images: Tensor, margin: Triple, *, turns: bool) -> tuple[Tensor, Tensor, Tensor | None]:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        volume = images.new_zeros((*(n + 2 * m for n, m in zip(images.shape[1:], margin, strict=True)), len(images)))
        volume[tuple(slice(m, m + n) for m, n in zip(margin, images.shape[1:], strict=True))] = images.movedim(0, -1)
        mean = F.pad(self.mean_power(images), [side for m in reversed(margin) for side in (m, m)])
        turn = None
        if turns:
            turn = torch.linalg.vecdot(volume[..., :-1], volume[..., 1:])  # conjugates the first
            turn = turn / mean.clamp_min(torch.finfo(mean.dtype).tiny).sqrt()
        return volume, mean, turn

    def box_sums(self, field: Tensor, middle: Tensor, half: Triple) -> Tensor:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        blocks = gather(field[..., None], middle - middle.new_tensor(half), triple(2 * h + 1 for h in half))
        return blocks.flatten(1).sum(1)

    def sums_around(self, field: Tensor, half: Triple) -> Callable[[Tensor], Tensor]:
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        for axis, h in enumerate(half):
            field = box_sum(field, 2 * h + 1, axis)
        return lambda middle: field[middle.unbind(1)]

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
        """See :class:`~torchsph.ultrasound.estimation.backends.TrackingBackend`."""
        return correlate(volume, apart, corner, offset, shape, ramp=ramp)
