"""Small chaotic and linear models with published filter scores; all batched over leading dimensions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


def runge_kutta(rate: Callable[[Tensor], Tensor], state: Tensor, step: float) -> Tensor:
    """One step of the classical fourth-order method for an autonomous rate."""
    first = rate(state)
    second = rate(state + 0.5 * step * first)
    third = rate(state + 0.5 * step * second)
    fourth = rate(state + step * third)
    return state + (step / 6) * (first + 2 * (second + third) + fourth)


@dataclass(frozen=True)
class Lorenz63:
    """`x' = s (y - x), y' = r x - y - x z, z' = x y - b z` (Lorenz 1963); `steps` of `step` per call."""

    step: float = 0.01
    steps: int = 25
    sigma: float = 10.0
    rho: float = 28.0
    beta: float = 8 / 3

    def rate(self, state: Tensor) -> Tensor:
        """`(..., 3)` -> `(..., 3)`."""
        x, y, z = state.unbind(-1)
        return torch.stack([self.sigma * (y - x), (self.rho - z) * x - y, x * y - self.beta * z], -1)

    def __call__(self, state: Tensor, generator: torch.Generator | None = None) -> Tensor:
        for _ in range(self.steps):
            state = runge_kutta(self.rate, state, self.step)
        return state


@dataclass(frozen=True)
class Lorenz96:
    """`x_i' = (x_i+1 - x_i-2) x_i-1 - x_i + F` on a ring (Lorenz 1996); `steps` of `step` per call."""

    step: float = 0.05
    steps: int = 1
    forcing: float = 8.0

    def rate(self, state: Tensor) -> Tensor:
        """`(..., n)` -> `(..., n)`."""
        ahead, behind, two_behind = (state.roll(shift, -1) for shift in (-1, 1, 2))
        return (ahead - two_behind) * behind - state + self.forcing

    def __call__(self, state: Tensor, generator: torch.Generator | None = None) -> Tensor:
        for _ in range(self.steps):
            state = runge_kutta(self.rate, state, self.step)
        return state


@dataclass(frozen=True)
class LinearAdvection:
    """Damped transport by one node a step on a ring, with smooth random forcing (Raanes et al. 2015).

    Forcing and initial state are sums of the first `waves` Fourier modes with independent normal amplitudes:
    variance `forcing` per step. `steps` steps a call.
    """

    size: int = 1000
    steps: int = 5
    damping: float = 0.98
    waves: int = 25
    forcing: float = 0.01

    def modes(self) -> Tensor:
        """`(2 waves, size)` rows whose outer product sums to the forcing's covariance."""
        place = torch.arange(self.size, dtype=torch.float64) / self.size
        phase = 2 * torch.pi * torch.arange(1, self.waves + 1, dtype=torch.float64).unsqueeze(-1) * place
        return (self.forcing / self.waves) ** 0.5 * torch.cat([phase.cos(), phase.sin()])

    def __call__(self, state: Tensor, generator: torch.Generator | None = None) -> Tensor:
        modes = self.modes().to(state.device)
        for _ in range(self.steps):
            shape = (*state.shape[:-1], len(modes))
            draw = torch.randn(shape, generator=generator, dtype=torch.float64).to(state.device)
            state = self.damping * state.roll(-1, -1) + draw @ modes
        return state
