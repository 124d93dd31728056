"""Parameters estimated together with the state: each member carries its own, the filter updates both."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import AssimilationError


@dataclass(frozen=True)
class Parameter:
    """One uncertain number of the model.

    It is updated in a coordinate without bounds, so that no analysis can leave [low, high]: its logarithm
    above a finite `low`, its logit between two finite bounds.

    Attributes:
        name: for dictionaries and messages.
        low: open lower bound; infinite by default.
        high: open upper bound; infinite by default.
        smallest_spread: standard deviation in the unbounded coordinate below which the ensemble is not let
            fall; a parameter has no dynamics that would restore its spread (Aksoy et al. 2006, MWR 134).
    """

    name: str
    low: float = -math.inf
    high: float = math.inf
    smallest_spread: float = 0.0

    def __post_init__(self) -> None:
        if not self.low < self.high or not self.smallest_spread >= 0:
            raise AssimilationError(f"parameter {self.name} needs low < high and smallest_spread >= 0")
        if math.isinf(self.low) and not math.isinf(self.high):
            raise AssimilationError(f"parameter {self.name}: an upper bound needs a lower one as well")

    def encode(self, value: Tensor) -> Tensor:
        """Into the unbounded coordinate; raises `AssimilationError` outside the bounds."""
        if not bool(((value > self.low) & (value < self.high)).all()):
            raise AssimilationError(f"parameter {self.name} must lie between {self.low} and {self.high}")
        if math.isinf(self.low):
            return value
        if math.isinf(self.high):
            return torch.log(value - self.low)
        return torch.logit((value - self.low) / (self.high - self.low))

    def decode(self, coordinate: Tensor) -> Tensor:
        """Back from the unbounded coordinate."""
        if math.isinf(self.low):
            return coordinate
        if math.isinf(self.high):
            return self.low + torch.exp(coordinate)
        return self.low + (self.high - self.low) * torch.sigmoid(coordinate)


@dataclass(frozen=True)
class Augmentation:
    """States `(*batch, N, n)` with k parameters behind them, `(*batch, N, n + k)`."""

    parameters: tuple[Parameter, ...]

    def join(self, ensemble: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        """States and `values[name] (*batch, N)` as one ensemble, in the dtype of the states."""
        if set(values) != {parameter.name for parameter in self.parameters}:
            raise AssimilationError(f"values for {sorted(values)} do not match the parameters of {self}")
        columns = [parameter.encode(values[parameter.name].double()) for parameter in self.parameters]
        return torch.cat([ensemble, torch.stack(columns, -1).to(ensemble.dtype)], -1)

    def split(self, ensemble: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """States and parameter values of each member, float64; too small a spread is widened here."""
        size = ensemble.shape[-1] - len(self.parameters)
        values = {}
        for parameter, column in zip(self.parameters, ensemble[..., size:].unbind(-1), strict=True):
            values[parameter.name] = parameter.decode(_widened(column.double(), parameter.smallest_spread))
        return ensemble[..., :size], values

    def positions(self, state_positions: Tensor, size: int) -> Tensor:
        """`(n + k, D)`: those of the n = `size` state variables, and NaN for the parameters (no place)."""
        places = state_positions.repeat(size // len(state_positions), 1)
        return torch.cat([places, places.new_full((len(self.parameters), places.shape[1]), torch.nan)])


def _widened(column: Tensor, smallest: float) -> Tensor:
    mean = column.mean(-1, keepdim=True)
    spread = column.std(-1, keepdim=True)
    tiny = torch.finfo(column.dtype).tiny
    return mean + (column - mean) * (smallest / spread.clamp(min=tiny)).clamp(min=1.0)
