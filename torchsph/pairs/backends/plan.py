"""Which passes a request for sums needs: terms, weights, coefficients; the same for C++ and Triton.

One formula serves every pressure form when the weights are chosen accordingly (csrc/rows.hpp): by volume,
w = m / rho with the pressure sum divided by rho_a afterwards, or by mass, w = m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from ..interface import MomentumTerms, RateTerms, Support
from ..smoothing_kernels import KERNELS, NUMBERS
from ..terms import (
    BY_MASS,
    BY_VOLUME,
    COMPANIES,
    FIELDS,
    PRESSURE_FORMS,
    RATE,
    SCALAR,
    SINGLE,
    TERMS,
    flags,
    outputs_of,
    reading,
)

(CONTINUITY, DIFFUSION, CONCENTRATION, XSPH, PRESSURE, ARTIFICIAL, LAMINAR, TENSILE) = (
    flags(name)
    for name in ("continuity", "diffusion", "concentration", "xsph", "pressure", "artificial", "laminar", "tensile")
)
SHEPARD, LAPLACIAN = flags("shepard"), flags("laplacian")
STRESSED, SLOPED = reading("stress"), reading("slope")
# the scalars of ``FIELDS`` in their order, which is that of their rows in the array of a Triton kernel
SCALARS = tuple(name for name, rank in FIELDS.items() if rank == SCALAR)

# what an incompressible step asks for at once; loops over these rates take Shepard's sums along
_WITH_SHEPARD = (CONTINUITY, CONTINUITY | CONCENTRATION)
_FILLING = CONTINUITY | CONCENTRATION | SHEPARD


@dataclass(frozen=True)
class Pass:
    """One loop over the pairs: the terms it sums and the weight that they share."""

    terms: int
    weight: int
    momentum: MomentumTerms | None = None

    @property
    def form(self) -> int:
        """Pressure form in the order of ``PRESSURE_FORMS``; 0 where there is no pressure."""
        if self.momentum is None or self.momentum.pressure is None:
            return 0
        return PRESSURE_FORMS.index(self.momentum.pressure)

    @property
    def outputs(self) -> list[str]:
        """Names of the sums, in the order in which a pass returns them."""
        return [output.name for output in outputs_of(self.terms)]


def rows_of(dimension: int) -> dict[str, slice]:
    """Where each field stands in the array of a Triton kernel."""
    vectors = {
        name: slice(k * dimension, (k + 1) * dimension) for k, name in enumerate(("position", "velocity", "slope"))
    }
    scalars = {name: slice(3 * dimension + k, 3 * dimension + k + 1) for k, name in enumerate(("weight", *SCALARS))}
    return vectors | scalars


def allocate(terms: int, position: Tensor) -> list[Tensor]:
    """Uninitialised results of a pass with these terms, (N,), (N, D) or (N, D, D)."""
    count, dimension = position.shape
    return [position.new_empty((count, *(dimension,) * output.rank)) for output in outputs_of(terms)]


@lru_cache
def rate_passes(terms: RateTerms) -> tuple[Pass, ...]:
    """The passes that give the first-pass sums."""
    asked = flags(*_asked(terms, RATE))
    passes: list[Pass] = []
    if terms.continuity == "volume":
        asked |= CONTINUITY
    elif terms.continuity == "mass":
        if asked & (DIFFUSION | CONCENTRATION):  # these are weighted by volume
            passes.append(Pass(CONTINUITY, BY_MASS))
        else:
            passes, asked = [Pass(CONTINUITY | asked, BY_MASS)], 0
    if terms.shepard and asked in _WITH_SHEPARD:
        asked, terms = asked | SHEPARD, replace(terms, shepard=False)
    return (*passes, *([Pass(asked, BY_VOLUME)] if asked else []), *_single_passes(terms))


def _asked(terms: RateTerms, kind: str) -> list[str]:
    """Names of the terms of a kind that a request switches on; the continuity has forms in place of a switch."""
    return [term.name for term in TERMS if term.kind == kind and getattr(terms, term.name, None) is True]


def force_pass(terms: MomentumTerms) -> Pass | None:
    """The pass that gives the acceleration; None where there is no force."""
    asked = (
        PRESSURE * (terms.pressure is not None)
        | ARTIFICIAL * (terms.artificial is not None)
        | LAMINAR * (terms.laminar is not None)
        | TENSILE * (terms.tensile is not None)
    )
    weight = BY_MASS if terms.pressure in (None, "symmetric") else BY_VOLUME
    return Pass(asked, weight, terms) if asked else None


def shared_passes(rates: RateTerms, momentum: MomentumTerms) -> Sequence[Pass] | None:
    """Passes that sum rates and forces in one loop; None for a combination that is not compiled so."""
    force = force_pass(momentum)
    if force is not None and force.terms == LAMINAR and [p.terms for p in rate_passes(rates)] == [_FILLING]:
        return [Pass(_FILLING | LAMINAR, BY_VOLUME, momentum)]
    if force is None or not force.terms & PRESSURE or force.terms & TENSILE or rates.concentration:
        return None
    if rates.continuity != ("volume" if force.weight == BY_VOLUME else "mass"):
        return None
    if rates.diffusion and force.weight == BY_MASS:
        return None
    asked = force.terms | CONTINUITY | DIFFUSION * rates.diffusion | XSPH * rates.xsph
    return [Pass(asked, force.weight, momentum), *_single_passes(rates)]


def _single_passes(terms: RateTerms) -> list[Pass]:
    names = _asked(terms, SINGLE)
    together = [company for company in COMPANIES if set(company) <= set(names)]
    alone = [name for name in names if not any(name in company for company in together)]
    return [Pass(flags(*company), BY_VOLUME) for company in (*((name,) for name in alone), *together)]


def coefficients(support: Support, momentum: MomentumTerms | None, members: int) -> Tensor:
    """(members, 4) float64: smoothing length, artificial and laminar viscosity, tensile coefficient."""
    artificial: float | Tensor = 0.0
    laminar: float | Tensor = 0.0
    tensile: float | Tensor = 0.0
    if momentum is not None:
        artificial = 0.0 if momentum.artificial is None else momentum.artificial
        laminar = 0.0 if momentum.laminar is None else momentum.laminar
        if momentum.tensile is not None:
            tensile = momentum.tensile / _shape_at(support, momentum.tensile_distance) ** 4
    values = (support.length, artificial, laminar, tensile)
    if not any(isinstance(value, Tensor) for value in values):  # every pass asks
        return torch.tensor([values] * members, dtype=torch.float64)
    table = torch.empty((members, 4), dtype=torch.float64)
    for column, value in enumerate(values):
        table[:, column] = value if not isinstance(value, Tensor) or value.ndim == 0 else value[:members]
    return table


def _shape_at(support: Support, distance: float) -> Tensor:
    length = torch.as_tensor(support.length, dtype=torch.float64)
    ratio = torch.as_tensor(distance, dtype=torch.float64) / length
    if bool((ratio >= support.kernel.support).any()):
        raise ValueError(f"tensile_distance {distance:g} lies outside the kernel's support; give the particle spacing")
    return support.kernel.shape(ratio)


def kernel_choice(support: Support, backend: str) -> tuple[int, list[float]]:
    """Number of a compiled-in kernel, and its support in smoothing lengths with sigma_D.

    Raises:
        ValueError: the kernel is neither one of ``smoothing_kernels.KERNELS`` nor a truncated Gaussian.
    """
    if support.per_particle:
        raise ValueError(f"the {backend} backend has one smoothing length per member; use backend='reference'")
    kernel = support.kernel
    family = "gaussian" if kernel.name.startswith("gaussian") else kernel.name
    known = family == "gaussian" or KERNELS.get(kernel.name) is kernel
    if not known:
        raise ValueError(
            f"the {backend} backend has no kernel '{kernel.name}' compiled in; use backend='reference', or "
            f"one of {', '.join(KERNELS)}"
        )
    return NUMBERS[family], [kernel.support, kernel.normalisation[support.dimension]]
