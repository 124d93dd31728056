"""Published scores of ensemble filters, as experiments with the number they should give.

The settings and the expected analysis errors are those that DAPPER (Raanes et al. 2024, JOSS 9, 5150) lists
in its `mods/<model>/<author year>.py`, after the papers named below. Two conversions: DAPPER states the
radius at which the taper equals exp(-1/2), the zero here lies 2 sqrt(10 / 3) times farther; and it inflates
everywhere, also where nothing is observed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from ..filters.base import Filter
from ..filters.enkf import StochasticEnKF
from ..filters.etkf import ETKF
from ..filters.inflation import Multiplicative
from ..filters.letkf import LETKF
from ..filters.localisation import Localisation
from .models import LinearAdvection, Lorenz63, Lorenz96
from .twin import Twin, TwinResult, run_twin

ZERO_PER_DAPPER_RADIUS = 2 * math.sqrt(10 / 3)


@dataclass(frozen=True)
class Benchmark:
    """A twin experiment, the filter's settings, and the published analysis RMSE (`sectors` by name)."""

    name: str
    source: str
    twin: Twin
    filter: Filter
    members: int
    cycles: int
    burn_in: int
    expected: float
    sectors: dict[str, tuple[torch.Tensor, float]]
    experiments: int = 5

    def run(self, *, experiments: int | None = None, seed: int = 0, cycles: int | None = None) -> TwinResult:
        """The scores of independent repetitions; `cycles` shortens or lengthens the runs."""
        return run_twin(
            self.twin,
            self.filter,
            members=self.members,
            cycles=cycles or self.cycles,
            burn_in=self.burn_in,
            experiments=experiments or self.experiments,
            seed=seed,
            sectors={name: mask for name, (mask, _) in self.sectors.items()},
        )


def lorenz96(observed: slice = slice(None), step: float = 0.05, steps: int = 1) -> Twin:
    """40 variables, F = 8, observation errors of variance 1 each 0.05 time units."""
    ring = torch.arange(40, dtype=torch.float64).unsqueeze(-1)
    start = torch.zeros(40, dtype=torch.float64)
    start[0] = 1.0
    return Twin(
        model=Lorenz96(step=step, steps=steps),
        start=start,
        modes=0.001**0.5 * torch.eye(40, dtype=torch.float64),
        observed=torch.arange(40)[observed],
        variance=1.0,
        position=ring,
    )


def lorenz63() -> Twin:
    """All three variables observed each 0.25 time units with errors of variance 2."""
    return Twin(
        model=Lorenz63(),
        start=torch.tensor([1.509, -1.531, 25.46], dtype=torch.float64),
        modes=2**0.5 * torch.eye(3, dtype=torch.float64),
        observed=torch.arange(3),
        variance=2.0,
    )


def linear_advection() -> Twin:
    """1000 nodes, 40 of them observed each 5 steps with errors of variance 0.01."""
    model = LinearAdvection()
    return Twin(
        model=model,
        start=torch.zeros(model.size, dtype=torch.float64),
        modes=5**0.5 * model.modes(),
        observed=torch.linspace(0, model.size, 41)[:-1].long(),
        variance=0.01,
    )


def _ring(dapper_radius: float, inflation: float, rotation: bool) -> LETKF:
    return LETKF(
        localisation=Localisation(dapper_radius * ZERO_PER_DAPPER_RADIUS, period=(40.0,)),
        patch=None,
        inflation=Multiplicative(inflation, everywhere=True),
        rotation=rotation,
    )


def benchmarks() -> list[Benchmark]:
    """All of them, in the order of the table in the documentation."""
    sakov08, sakov12 = "Sakov & Oke 2008, Tellus A 60", "Sakov et al. 2012, MWR 140, table 1"
    raanes15, miyoshi11 = "Raanes et al. 2015, MWR 143, fig. 2", "Miyoshi 2011, MWR 139, fig. 5"
    land = {"land": (torch.arange(20), 0.38), "ocean": (torch.arange(20, 40), 2.9)}
    sqrt, noisy = ETKF, StochasticEnKF

    def etkf(factor: float, rotation: bool) -> ETKF:
        return sqrt(inflation=Multiplicative(factor), rotation=rotation)

    def enkf(factor: float) -> StochasticEnKF:
        return noisy(inflation=Multiplicative(factor))

    ring, chaos, waves = lorenz96(), lorenz63(), linear_advection()
    half = lorenz96(observed=slice(20), step=0.005, steps=10)
    return [
        Benchmark("L96 ETKF N24", sakov08, ring, etkf(1.013, True), 24, 1400, 400, 0.18, {}),
        Benchmark("L96 stochastic N40", sakov08, ring, enkf(1.06), 40, 1400, 400, 0.22, {}),
        Benchmark("L96 LETKF N7", sakov08, ring, _ring(4, 1.04, True), 7, 1400, 400, 0.22, {}),
        Benchmark("L63 ETKF N10", sakov12, chaos, etkf(1.02, True), 10, 1064, 64, 0.60, {}),
        Benchmark("L63 ETKF N3", sakov12, chaos, etkf(1.30, False), 3, 1064, 64, 0.80, {}),
        # With 10 members some runs lose the truth for a while: 15 of them make a steady median.
        Benchmark("L63 stochastic N10", sakov12, chaos, enkf(1.04), 10, 1064, 64, 0.65, {}, 15),
        Benchmark("L63 stochastic N100", sakov12, chaos, enkf(1.01), 100, 1064, 64, 0.56, {}),
        Benchmark("advection ETKF N30", raanes15, waves, etkf(1.0, False), 30, 212, 12, 0.304, {}),
        Benchmark("advection stochastic N30", raanes15, waves, enkf(3.2), 30, 212, 12, 0.30, {}),
        Benchmark(
            "L96 land only LETKF N10",
            miyoshi11,
            half,
            _ring(3, 1.015**0.5, False),
            10,
            4000,
            1500,
            2.1,
            land,
        ),
    ]
