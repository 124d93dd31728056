"""Which passes a request for sums needs: terms, weights, coefficients; the same for C++ and Triton.

One formula serves every pressure form when the weights are chosen accordingly (csrc/rows.hpp): by volume,
w = m / rho with the pressure sum divided by rho_a afterwards, or by mass, w = m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..interface import PRESSURE_FORMS, MomentumTerms, RateTerms, Support
from ..smoothing_kernels import KERNELS

# sph::Term of csrc/rows.hpp
CONTINUITY, DIFFUSION, CONCENTRATION, XSPH = 1, 2, 4, 8
PRESSURE, ARTIFICIAL, LAMINAR, TENSILE = 16, 32, 64, 128
SHEPARD, RENORMALISATION, LAPLACIAN = 256, 512, 1024
GRADIENT, CORRECTED_DIFFUSION, MOMENTS = 2048, 4096, 8192
BY_VOLUME, BY_MASS = 0, 1
# the order of sph::Kernel in csrc/smoothing.hpp
KERNEL_ORDER = ("wendland_c2", "wendland_c4", "wendland_c6", "cubic", "quintic", "gaussian", "spiky")

_SCALAR, _VECTOR, _MATRIX = 0, 1, 2
# the sums that each term fills, with the rank of their trailing shape
_OUTPUTS: tuple[tuple[int, str, int], ...] = (
    (CONTINUITY, "divergence", _SCALAR),
    (DIFFUSION, "diffusion", _SCALAR),
    (CONCENTRATION, "concentration", _VECTOR),
    (XSPH, "xsph", _VECTOR),
    (PRESSURE | ARTIFICIAL | LAMINAR, "acceleration", _VECTOR),
    (SHEPARD, "shepard_volume", _SCALAR),
    (SHEPARD, "shepard_mass", _SCALAR),
    (RENORMALISATION, "renormalisation", _MATRIX),
    (LAPLACIAN, "laplacian", _SCALAR),
    (LAPLACIAN, "diagonal", _SCALAR),
    (GRADIENT, "gradient", _VECTOR),
    (CORRECTED_DIFFUSION, "diffusion", _SCALAR),
    (MOMENTS, "moment_first", _VECTOR),
    (MOMENTS, "moment_second", _MATRIX),
    (MOMENTS, "moment_mass", _VECTOR),
)

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
        return [name for flag, name, _ in _OUTPUTS if self.terms & flag]


def allocate(terms: int, position: Tensor) -> list[Tensor]:
    """Uninitialised results of a pass with these terms, (N,), (N, D) or (N, D, D)."""
    count, dimension = position.shape
    return [position.new_empty((count, *(dimension,) * rank)) for flag, _, rank in _OUTPUTS if terms & flag]


def rate_passes(terms: RateTerms) -> list[Pass]:
    """The passes that give the first-pass sums."""
    flags = DIFFUSION * terms.diffusion | CONCENTRATION * terms.concentration | XSPH * terms.xsph
    passes = []
    if terms.continuity == "volume":
        flags |= CONTINUITY
    elif terms.continuity == "mass":
        if flags & (DIFFUSION | CONCENTRATION):  # these are weighted by volume
            passes.append(Pass(CONTINUITY, BY_MASS))
        else:
            passes, flags = [Pass(CONTINUITY | flags, BY_MASS)], 0
    if terms.shepard and flags in _WITH_SHEPARD:
        flags, terms = flags | SHEPARD, replace(terms, shepard=False)
    return passes + ([Pass(flags, BY_VOLUME)] if flags else []) + _separate_passes(terms)


def force_pass(terms: MomentumTerms) -> Pass | None:
    """The pass that gives the acceleration; None where there is no force."""
    flags = (
        PRESSURE * (terms.pressure is not None)
        | ARTIFICIAL * (terms.artificial is not None)
        | LAMINAR * (terms.laminar is not None)
        | TENSILE * (terms.tensile is not None)
    )
    weight = BY_MASS if terms.pressure in (None, "symmetric") else BY_VOLUME
    return Pass(flags, weight, terms) if flags else None


def shared_passes(rates: RateTerms, momentum: MomentumTerms) -> list[Pass] | None:
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
    flags = force.terms | CONTINUITY | DIFFUSION * rates.diffusion | XSPH * rates.xsph
    return [Pass(flags, force.weight, momentum), *_separate_passes(rates)]


def _separate_passes(terms: RateTerms) -> list[Pass]:
    wanted = (
        (terms.shepard, SHEPARD),
        (terms.renormalisation and not terms.gradient, RENORMALISATION),
        (terms.gradient and not terms.renormalisation, GRADIENT),
        (terms.gradient and terms.renormalisation, GRADIENT | RENORMALISATION),
        (terms.corrected_diffusion, CORRECTED_DIFFUSION),
        (terms.moments, MOMENTS),
    )
    return [Pass(flag, BY_VOLUME) for asked, flag in wanted if asked]


def coefficients(support: Support, momentum: MomentumTerms | None, members: int) -> Tensor:
    """(members, 4) float64: smoothing length, artificial and laminar viscosity, tensile coefficient."""
    artificial, laminar, tensile = 0.0, 0.0, 0.0
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
    """Index in ``KERNEL_ORDER``, and support in smoothing lengths with sigma_D, of a compiled-in kernel.

    Raises:
        ValueError: the kernel is not one of ``torchsph.smoothing``.
    """
    if support.per_particle:
        raise ValueError(f"the {backend} backend has one smoothing length per member; use backend='reference'")
    kernel = support.kernel
    family = "gaussian" if kernel.name.startswith("gaussian") else kernel.name
    known = family == "gaussian" or KERNELS.get(kernel.name) is kernel
    if family not in KERNEL_ORDER or not known:
        raise ValueError(
            f"the {backend} backend has no kernel '{kernel.name}' compiled in; use backend='reference', or "
            f"one of {', '.join(KERNEL_ORDER)}"
        )
    return KERNEL_ORDER.index(family), [kernel.support, kernel.normalisation[support.dimension]]
