"""Twin experiments: a truth and its observations are simulated, and a filter has to find the truth again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import AssimilationError
from ..filters.base import Filter
from ..observations import Observations


@dataclass(frozen=True)
class Twin:
    """A synthetic problem whose truth is known.

    Attributes:
        model: `model(state (..., n), generator)` advances to the next observation, with its own random
            forcing if it has any.
        start: `(n,)` mean of the initial state.
        modes: `(q, n)` initial covariance `modes' modes`.
        observed: `(m,)` indices of the observed numbers.
        variance: of the observation errors.
        position: `(n, D)`, or None.
    """

    model: Callable[[Tensor, torch.Generator], Tensor]
    start: Tensor
    modes: Tensor
    observed: Tensor
    variance: float
    position: Tensor | None = None


@dataclass(frozen=True)
class TwinResult:
    """Time means after burn-in, `(experiments,)` each.

    `error` is the RMSE of the analysis over the state, `spread` what the filter expects of it (the root of
    its mean variance), `sectors` the RMSE of parts of the state. `diverged` marks experiments that know
    less than the climate: an error above the truth's own standard deviation in time.
    """

    error: Tensor
    spread: Tensor
    sectors: dict[str, Tensor]
    diverged: Tensor

    @property
    def median(self) -> float:
        """Over the experiments; the score that published values are compared with."""
        return self.error.median().item()


def run_twin(
    twin: Twin,
    filter_: Filter,
    *,
    members: int,
    cycles: int,
    burn_in: int,
    experiments: int = 5,
    seed: int = 0,
    sectors: dict[str, Tensor] | None = None,
) -> TwinResult:
    """Run `experiments` independent twins side by side (one batch) and score the last `cycles - burn_in`."""
    if not 0 <= burn_in < cycles:
        raise AssimilationError(f"burn_in must lie in [0, cycles), got {burn_in} of {cycles}")
    generator = torch.Generator().manual_seed(seed)
    everything = torch.arange(len(twin.start))
    masks = {"": everything, **(sectors or {})}
    truth = _draw(twin, (experiments,), generator)
    ensemble = _draw(twin, (experiments, members), generator)
    variance = torch.full((len(twin.observed),), twin.variance, dtype=torch.float64)
    place = None if twin.position is None else twin.position[twin.observed]
    error = {name: torch.zeros(experiments, dtype=torch.float64) for name in masks}
    spread = torch.zeros(experiments, dtype=torch.float64)
    climate = torch.zeros(2, *truth.shape, dtype=torch.float64)
    for cycle in range(cycles):
        truth, ensemble = twin.model(truth, generator), twin.model(ensemble, generator)
        noise = torch.randn((experiments, len(variance)), generator=generator, dtype=torch.float64)
        value = truth[:, twin.observed] + twin.variance**0.5 * noise
        analysis = filter_.analyse(
            ensemble,
            ensemble[..., twin.observed],
            Observations(value, variance, place),
            state_positions=twin.position,
            generator=generator,
        )
        ensemble = analysis.ensemble
        if cycle >= burn_in:
            miss = (analysis.mean - truth).square()
            for name, mask in masks.items():
                error[name] += miss[:, mask].mean(-1).sqrt() / (cycles - burn_in)
            spread += analysis.spread_after / (cycles - burn_in)
            climate += torch.stack([truth, truth.square()]) / (cycles - burn_in)
    total = error.pop("")
    deviation = (climate[1] - climate[0].square()).mean(-1).sqrt()
    return TwinResult(total, spread, error, ~(total < deviation))


def _draw(twin: Twin, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    draw = torch.randn((*shape, len(twin.modes)), generator=generator, dtype=torch.float64)
    return twin.start + draw @ twin.modes
