"""Volume of the cavity and its rate of change over time: what open valves have to pass."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from geometry import WallMotion

from ..state.units import Units

# samples of dV/dt between key frames; the flux is linear between them
_FLUX_SAMPLES = 8


class CavityVolume:
    """Tables of V and dV/dt of a cavity, internal units.

    Args:
        motion: of the walls.
        units: internal units.
        wrapped_time: the time (s) among the key frames that a time (s) stands for, by the motion's period.
        with_volume: whether V is asked for, not dV/dt alone.
        device: of what is looked up.
        dtype: of what is looked up.
    """

    def __init__(
        self,
        motion: WallMotion,
        units: Units,
        wrapped_time: Callable[[float], float],
        with_volume: bool,
        device: str,
        dtype: torch.dtype,
    ) -> None:
        self._wrapped, self.device, self.dtype = wrapped_time, device, dtype
        key = np.asarray(motion.time)
        fraction = np.arange(_FLUX_SAMPLES) / _FLUX_SAMPLES
        self._times = np.append((key[:-1, None] + fraction * np.diff(key)[:, None]).ravel(), key[-1])
        unit = units.length**motion.dimension
        self._rates = np.array([motion.volume_rate(t) for t in self._times]) * (units.time / unit)
        self._volumes: np.ndarray | None = None
        if with_volume:
            self._volumes = np.array([motion.volume(t) for t in self._times]) / unit

    def rate(self, times: Tensor) -> Tensor:
        """dV/dt at times (s): what has to enter through the open valves together."""
        return self._looked_up(self._rates, times, self.dtype)

    def rate_at(self, time: float) -> float:
        """dV/dt at one time (s)."""
        return float(np.interp(self._wrapped(time), self._times, self._rates))

    def volume(self, times: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """V at times (s), in ``dtype`` or that of the tables."""
        if self._volumes is None:
            raise ValueError("the volume of this cavity was not tabulated; ask for it with with_volume=True")
        return self._looked_up(self._volumes, times, dtype or self.dtype)

    def _looked_up(self, table: np.ndarray, times: Tensor, dtype: torch.dtype) -> Tensor:
        value = np.interp([self._wrapped(time) for time in times.tolist()], self._times, table)
        return torch.as_tensor(value, dtype=dtype, device=self.device)
