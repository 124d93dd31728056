"""The one interface to the pair sums: what a backend reads, which sums it can be asked for, what it returns.

Quantities are in any consistent units; the simulator calls with lengths in particle spacings and velocities
in its reference speed.  All particles of all members stand in one flat array, ordered as the caller likes,
and ``member`` says to which member each belongs: particles of different members never interact.  Density is
carried as its relative deviation  d = (rho - rho0) / rho0,  because float32 would lose it in rho; pressure
is p / rho0 and mass is m / rho0, so that  m / (1 + d)  is a volume.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from .poisson import PoissonProblem, PoissonSolution, solve
from .smoothing_kernels import SmoothingKernel
from .terms import PRESSURE_FORMS

CONTINUITY_FORMS = ("volume", "mass")
# what a backend's search returns: its own affair
Pairs = TypeVar("Pairs")


@dataclass(frozen=True)
class Support:
    """Kernel and smoothing length of a pass.

    Attributes:
        kernel: the smoothing kernel W.
        length: a float, a tensor (members,), or with ``per_particle`` a tensor (N,): then a pair has the
            mean of its two lengths (Benz 1990; the reference only).
        dimension: 2 or 3.
        per_particle: whether ``length`` is given for each particle.
    """

    kernel: SmoothingKernel
    length: float | Tensor
    dimension: int
    per_particle: bool = False

    @property
    def radius(self) -> float:
        """Largest support radius over members or particles."""
        longest = float(self.length.max()) if isinstance(self.length, Tensor) else self.length
        return self.kernel.support * longest


@dataclass(frozen=True)
class PairState:
    """Flat particle arrays that a pass reads.

    Attributes:
        position: (N, D).
        velocity: (N, D).
        mass: (N,), m / rho0.
        deviation: (N,), (rho - rho0) / rho0.
        pressure: (N,), p / rho0; only the momentum pass reads it.
        member: (N,) int64.
        slope: (N, D), renormalised gradient of the deviation; only the corrected diffusion reads it.
    """

    position: Tensor
    velocity: Tensor
    mass: Tensor
    deviation: Tensor
    pressure: Tensor
    member: Tensor
    slope: Tensor | None = None

    @property
    def volume(self) -> Tensor:
        """m / rho, (N,)."""
        return self.mass / (1.0 + self.deviation)


@dataclass(frozen=True)
class RateTerms:
    """Which first-pass sums are wanted; a sum that is not asked for is neither computed nor stored.

    Attributes:
        continuity: "volume":  sum_b V_b (v_b - v_a) . grad W  (velocity divergence);
            "mass":  sum_b m_b (v_b - v_a) . grad W  (minus the density rate of Grønli 2017,
            eq. 2.19); None: not wanted.
        diffusion: sum_b 2 V_b (d_b - d_a) (x_b - x_a) . grad W / r^2 with the sign that spreads d
            (Molteni & Colagrossi 2009 eq. 2 without its prefactor).
        concentration: sum_b V_b grad W (particle shifting, Lind et al. 2012 eq. 23).
        xsph: sum_b 2 m_b / (rho_a + rho_b) (v_b - v_a) W (Grønli 2017, errata to eq. 2.33).
        shepard: sums of V_b W and of m_b W over b, with b = a (Grønli 2017, eq. 2.20).
        renormalisation: sum_b V_b (x_b - x_a) (x) grad W (Bonet & Lok 1999 eq. 45), (N, D, D).
        gradient: sum_b V_b (d_b - d_a) grad W, (N, D); the inverse of the renormalisation makes it exact for
            linear d.
        corrected_diffusion: as ``diffusion`` with (d_b - d_a) - (slope_a + slope_b) . (x_b - x_a) / 2 for
            d_b - d_a (Antuono et al. 2010 eq. 4), so that a hydrostatic density is left alone; it fills
            ``Rates.diffusion`` and reads ``PairState.slope``.
        moments: sums of V_b W s, V_b W s (x) s and m_b W s with s = x_b - x_a, which with ``shepard`` give
            the moving-least-squares density (Dilts 1999; Colagrossi & Landrini 2003 eq. 12-14).
    """

    continuity: str | None = "volume"
    diffusion: bool = False
    concentration: bool = False
    xsph: bool = False
    shepard: bool = False
    renormalisation: bool = False
    gradient: bool = False
    corrected_diffusion: bool = False
    moments: bool = False

    def __post_init__(self) -> None:
        if self.diffusion and self.corrected_diffusion:
            raise ValueError("diffusion and corrected_diffusion are two forms of one term: ask for one of them")
        if self.continuity is not None and self.continuity not in CONTINUITY_FORMS:
            raise ValueError(f"continuity must be one of {CONTINUITY_FORMS} or None, got '{self.continuity}'")


@dataclass(frozen=True)
class Rates:
    """First-pass sums; a sum that was not asked for is None."""

    divergence: Tensor | None = None
    diffusion: Tensor | None = None
    concentration: Tensor | None = None
    xsph: Tensor | None = None
    shepard_volume: Tensor | None = None
    shepard_mass: Tensor | None = None
    renormalisation: Tensor | None = None
    gradient: Tensor | None = None
    moment_first: Tensor | None = None
    moment_second: Tensor | None = None
    moment_mass: Tensor | None = None


@dataclass(frozen=True)
class MomentumTerms:
    """Which accelerations the second pass adds up; every coefficient is a float or a tensor (members,).

    Attributes:
        pressure: "symmetric": -sum m_b (p_a/rho_a^2 + p_b/rho_b^2) grad W (Grønli 2017,
            eq. 2.23);
            "sum": -sum m_b (p_a + p_b)/(rho_a rho_b) grad W (Colagrossi & Landrini 2003 eq. 8);
            "switched": as "sum" with p_a replaced by |p_a| (Sun et al. 2017 eq. 11: tensile control);
            "difference": as "sum" with -p_a (exact for constant pressure, not conservative); None: none.
        artificial: alpha * c in Grønli 2017, eq. 2.29 (speed); None switches the artificial viscosity off.
        laminar: kinematic viscosity nu of Morris, Fox & Zhu 1997 eq. 22; None switches it off.
        tensile: coefficient R of Monaghan 2000 (0.2 there, for the symmetric form); None switches it off.
        tensile_distance: distance at which its weight (W(r)/W(r0))^4 is one (the particle spacing).
    """

    pressure: str | None = "symmetric"
    artificial: float | Tensor | None = None
    laminar: float | Tensor | None = None
    tensile: float | None = None
    tensile_distance: float = 1.0

    def __post_init__(self) -> None:
        if self.pressure is not None and self.pressure not in PRESSURE_FORMS:
            raise ValueError(f"pressure must be one of {PRESSURE_FORMS} or None, got '{self.pressure}'")
        if self.tensile is not None and self.pressure != "symmetric":
            raise ValueError(f"the tensile term belongs to the symmetric pressure form, got pressure '{self.pressure}'")


@dataclass(frozen=True)
class Moments:
    """Sums over the particles b around query points, with offset s = x_b - x_query and weight W(|s|, h).

    Attributes:
        count: (M,) number of particles with a positive weight, in the dtype of the others.
        value: (M,) sum of W.
        first: (M, D) of W s.
        second: (M, D, D) of W s (x) s.
        field: (M, C) of W A.
        field_first: (M, D, C) of W s (x) A.
    """

    count: Tensor
    value: Tensor
    first: Tensor
    second: Tensor
    field: Tensor
    field_first: Tensor


class Backend(ABC, Generic[Pairs]):
    """A way to evaluate the pair sums.  ``pairs`` is whatever ``search`` returned, opaque to the caller.

    Attributes:
        overflows: searches that were made again because a list outgrew its room (nothing is ever dropped).
        differentiable: whether torch can differentiate the sums.
    """

    name: str
    overflows = 0
    differentiable = False

    @abstractmethod
    def search(
        self,
        position: Tensor,
        member: Tensor,
        radius: float,
        *,
        margin: float = 0.0,
        period: Tensor | None = None,
    ) -> Pairs:
        """Find the pairs closer than ``radius + margin``.

        The result serves until a particle has moved by ``margin / 2``.

        Args:
            position: (N, D).
            member: (N,) int64.
            radius: of the kernel's support.
            margin: added to the radius.
            period: (D,) of each axis, inf where it is not periodic; None: no axis is.

        Raises:
            ValueError: a position is not finite, or a period is shorter than three radii.
        """

    def order(self, pairs: Pairs) -> Tensor | None:
        """Particle indices (N,) in an order that makes the sums faster; None: it does not matter."""
        return None

    @abstractmethod
    def rates(self, pairs: Pairs, state: PairState, support: Support, terms: RateTerms) -> Rates:
        """First pass: sums over neighbours that need positions, velocities and densities."""

    @abstractmethod
    def momentum(self, pairs: Pairs, state: PairState, support: Support, terms: MomentumTerms) -> Tensor:
        """Second pass: acceleration (N, D)."""

    def right_hand_side(
        self, pairs: Pairs, state: PairState, support: Support, rates: RateTerms, momentum: MomentumTerms
    ) -> tuple[Rates, Tensor]:
        """Both passes at one state, where pressure does not wait for rates; a backend may share the loop."""
        return self.rates(pairs, state, support, rates), self.momentum(pairs, state, support, momentum)

    @abstractmethod
    def laplacian(
        self, pairs: Pairs, state: PairState, support: Support, field: Tensor, active: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """sum_b 2 V_b (-F) r^2/(r^2 + 0.01 h^2) (field_a - field_b) and its diagonal, both (N,).

        Args:
            pairs: of ``search``.
            state: the particles.
            support: kernel and smoothing length.
            field: (N,).
            active: (N,) bool, only pairs of two active particles count; None: all.
        """

    def poisson(
        self,
        pairs: Pairs,
        state: PairState,
        support: Support,
        source: Tensor,
        start: Tensor | None,
        *,
        free: Tensor,
        active: Tensor,
        singular: Tensor,
        tolerance: float,
        iterations: int,
        group: Tensor | None = None,
    ) -> PoissonSolution:
        """Solve ``laplacian`` u = ``source`` (N,) for each group by itself; a backend may do it in one piece.

        Args:
            pairs: of ``search``.
            state: the particles.
            support: kernel and smoothing length.
            source: (N,).
            start: (N,), a guess; None: 0.
            free: (N,) bool, the unknowns; elsewhere u is 0.
            active: (N,) bool, as in ``laplacian``.
            singular: (groups,) bool, where u is determined up to a constant and the mean of the source is taken out.
            tolerance: of the residual relative to the source.
            iterations: at most.
            group: (N,) int64, sets of particles that do not interact; None: the members.
        """
        diagonal = self.laplacian(pairs, state, support, torch.zeros_like(source), active)[1]
        problem = PoissonProblem(
            lambda u: self.laplacian(pairs, state, support, u, active)[0],
            diagonal,
            state.mass,
            free,
            singular,
            state.member if group is None else group,
            singular.shape[0],
        )
        return solve(problem, source, start, tolerance=tolerance, iterations=iterations)

    @abstractmethod
    def interpolate(
        self,
        position: Tensor,
        member: Tensor,
        fields: Tensor,
        support: Support,
        query: Tensor,
        query_member: Tensor,
        *,
        period: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Moments:
        """Moments of a first-order moving-least-squares fit at query points.

        Args:
            position: (N, D) of the particles.
            member: (N,) int64.
            fields: (N, C) of the particles.
            support: kernel and smoothing length.
            query: (M, D).
            query_member: (M,) int64; a query sees the particles of its own member only.
            period: (D,) of each axis, inf where it is not periodic; None: no axis is.
            weight: (N,) of the particles, not negative, that W is multiplied by; None: all one.
        """


def check_search(position: Tensor | None, radius: float, period: Tensor | None) -> None:
    """Raise ValueError where no backend could search: non-finite positions, or a period under three radii.

    A backend that checks the positions itself while it sorts them passes None.
    """
    if radius <= 0:
        raise ValueError(f"the search radius must be positive, got {radius}")
    if position is not None and not torch.isfinite(position).all():
        bad = int((~torch.isfinite(position).all(dim=1)).sum())
        raise ValueError(f"{bad} particle positions are not finite; freeze or remove them before the search")
    if period is not None and bool((period < 3 * radius).any()):
        raise ValueError(
            f"a periodic axis of length {float(period.min()):g} is shorter than three search radii "
            f"({3 * radius:g}); use a finer spacing or a longer period"
        )
