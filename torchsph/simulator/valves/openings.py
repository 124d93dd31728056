"""An open orifice as the particles' simulator sees it: its plane, area, rim and the channel behind it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from geometry import OrificePlane
from geometry.motion.orifices import rim_distance
from torchsph.pairs.vectors import square_length

# half the width (spacings) over which what stands over an opening is blended in
_RIM = 0.5


class Frame:
    """An opening in internal units on the device."""

    def __init__(
        self,
        plane: OrificePlane,
        velocity: np.ndarray,
        length: float,
        dtype: torch.dtype,
        device: str,
    ) -> None:
        def tensor(value: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(value), dtype=dtype, device=device)

        plane = OrificePlane(
            plane.centroid / length,
            plane.normal,
            plane.area / length ** len(plane.basis),
            plane.basis,
            plane.rim / length,
            plane.edges,
        )
        self.centre, self.normal, self.basis = tensor(plane.centroid), tensor(plane.normal), tensor(plane.basis)
        self.area = float(plane.area)
        self.velocity = tensor(velocity)
        self._outline, self._edges = tensor(plane.outline), torch.from_numpy(plane.edges).to(device)
        self.radius = float(np.linalg.norm(plane.outline, axis=1).max())
        self._clear = float(self.inset(self.centre[None]).clamp_min(0.0))  # nothing of the rim is nearer to the middle

    def height(self, position: Tensor) -> Tensor:
        """Outward distance from the plane, (n,)."""
        return (position - self.centre) @ self.normal

    def inset(self, position: Tensor) -> Tensor:
        """In-plane distance from the rim, (n,), positive over the opening."""
        return rim_distance((position - self.centre) @ self.basis.T, self._outline, self._edges)

    def cover(self, position: Tensor) -> Tensor:
        """Part of points (n, D) over the opening, (n,): blended in over a spacing at the rim."""
        aside = square_length(position - self.centre) - self.height(position).square()
        part = (aside < self._clear**2).to(position.dtype)
        low, high = max(self._clear - _RIM, 0.0), self.radius + _RIM
        rim = torch.nonzero((aside > low * low) & (aside < high * high)).squeeze(1)
        return part.index_copy(0, rim, (self.inset(position[rim]) / (2.0 * _RIM) + 0.5).clamp(0.0, 1.0))

    def behind(self, position: Tensor) -> Tensor:
        """(n,) bool: points (n, D) less than half a spacing before the opening, or in the channel behind it."""
        height = self.height(position)
        aside = (position - self.centre - height[:, None] * self.normal).norm(dim=1)
        return (height > -0.5) & (aside < self.radius + 1.0)

    def lattice(self, length: float) -> Tensor:
        """Unit lattice in the channel of the given length behind the opening, (n, D)."""
        reach = int(np.ceil(self.radius)) + 1
        axis = torch.arange(-reach, reach, dtype=self.centre.dtype, device=self.centre.device) + 0.5
        flat = torch.cartesian_prod(*[axis] * self.basis.shape[0]).reshape(-1, self.basis.shape[0])
        place = self.centre + flat @ self.basis
        place = place[self.inset(place) > 0]
        layers = torch.arange(int(length), dtype=place.dtype, device=place.device) + 0.5
        return (place[:, None, :] + layers[None, :, None] * self.normal).reshape(-1, self.centre.shape[0])
