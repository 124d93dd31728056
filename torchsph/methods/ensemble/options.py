"""Settings of the ensemble's cycle, and the parameters that it may learn."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from geometry.arguments import checked
from torchsph.assimilation import Parameter
from torchsph.simulator.grid_forecast import Transfer

INCREMENTS = ("spline", "ensemble")


@checked
@dataclass(frozen=True)
class Estimated:
    """A parameter of the simulator that the members disagree about and the filter learns.

    Attributes:
        parameter: its name is one of ``Simulation.change``'s ("viscosity", "sound_speed", "valve_strength", ...), with
            its bounds.
        value: first guess. spread: standard deviation of the first guess in the parameter's unbounded coordinate (its
            logarithm above a lower bound).
    """

    parameter: Parameter
    value: float
    spread: float

    def __post_init__(self) -> None:
        if not self.spread > 0:
            raise ValueError(f"Estimated.spread of {self.parameter.name} must be positive, got {self.spread}")

    def draw(self, members: int, generator: torch.Generator) -> Tensor:
        """(members,) first guesses."""
        middle = self.parameter.encode(torch.tensor([self.value], dtype=torch.float64))
        noise = torch.randn(members, generator=generator, dtype=torch.float64)
        return self.parameter.decode(middle + self.spread * (noise - noise.mean()))


@checked
@dataclass(frozen=True)
class EnsembleOptions:
    """Settings of the cycle; lengths and speeds are relative to the scene, so that hearts of any size fit.

    Attributes:
        model_error: RMS per component of the perturbations added to every forecast, share of the RMS of the control
            or of all splines, whichever is larger.
        length: deviation (m) of the Gaussian that smooths them; None: that of the measurement's kernel, because nothing
            finer is corrected by it, and at least a grid spacing.
        localisation: radius at which observations lose all influence, share of the walls' longest extent.
        relaxation: RTPS factor. gross_error: rejection limit in expected standard deviations, or None.
        increments: what the estimate's analysis is put together from: "spline", "ensemble" (the filter's) or both. The
            members' anomalies are the filter's in any case. On the phantom the spline alone did as well as both
            (NRMSE .30 and .30 of the flow in filling, .41 and .45 over a beat at two noise levels) and costs less.
        choose_every: frames after which the smoothness of the innovations is chosen anew.
        memory: cycles over which gains and error scales are averaged.
        kernel: full width at half maximum (m) of the measurements' resolution; None: as their noise shows it.
        batch: members that are simulated together; processes share whole batches.
        lag: cycles whose measurements still move an analysis after its own (``LaggedAnalyses``), or None. Off, because
            on the phantom it does harm: with 16 members NRMSE .405, .405 and .413 over the beat with lags of 0, 1
            and 4, and the claim falls from .81 of the error to .65 and .43. Perturbations that are fresh in every
            cycle leave the members little that ties them to their own past, and what so few sample of it is mostly
            chance.
        minimum_members: a forecast that fewer members live through ends the run; None: those that are left go on as
            long as there is one, and failed ones are replaced by them.
        transfer: how grid forecasts are put together.
        estimated: parameters of the simulator to be learned.
    """

    model_error: float = 0.2
    length: float | None = None
    localisation: float = 0.33
    relaxation: float = 0.5
    gross_error: float | None = 5.0
    increments: tuple[str, ...] = ("spline",)
    choose_every: int = 3
    memory: float = 8.0
    kernel: float | None = None
    batch: int = 8
    lag: int | None = None
    minimum_members: int | None = None
    transfer: Transfer = Transfer()
    estimated: tuple[Estimated, ...] = ()

    def __post_init__(self) -> None:
        for name in ("length", "localisation", "choose_every", "batch", "lag", "minimum_members"):
            if getattr(self, name) is not None and not getattr(self, name) > 0:
                raise ValueError(f"EnsembleOptions.{name} must be positive, got {getattr(self, name)}")
        for name in ("model_error", "relaxation"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"EnsembleOptions.{name} must lie in [0, 1], got {getattr(self, name)}")
        if not self.memory >= 1:
            raise ValueError(f"EnsembleOptions.memory must be at least 1 cycle, got {self.memory}")
        if self.kernel is not None and not self.kernel >= 0:
            raise ValueError(f"EnsembleOptions.kernel must be None or not negative (m), got {self.kernel}")
        if not self.increments or not set(self.increments) <= set(INCREMENTS):
            raise ValueError(f"EnsembleOptions.increments must name some of {INCREMENTS}, got {self.increments}")
