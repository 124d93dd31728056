"""The table of pair terms: what each one reads and fills, and how its sums are scaled; every backend goes by it.

``native/build.py`` writes the C++ enums and lists from here (csrc/terms.hpp) and reads this file by its path where
there is no torch: it imports the standard library alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

# ranks of what a particle has or gets
SCALAR, VECTOR, MATRIX = 0, 1, 2
# powers of 1 / h beyond the dimension: a sum holds the kernel's value, W = sigma / h^D w(q), or its slope,
# dW/dr / r = sigma / h^(D+2) w'(q) / q
VALUE, SLOPE = 0, 2
# the weights w of the partners b that a pass may have: m / rho or m
BY_VOLUME, BY_MASS = 0, 1
WEIGHTS = {"by_volume": BY_VOLUME, "by_mass": BY_MASS}
# kinds of terms
RATE, ACCELERATION, SINGLE = "rate", "acceleration", "single"
PRESSURE_FORMS = ("symmetric", "sum", "switched", "difference")

# what a term may read of both particles of a pair beside places and the partner's weight, with its rank
FIELDS = {
    "velocity": VECTOR,
    "slope": VECTOR,
    "stress": SCALAR,
    "inertia": SCALAR,
    "inverse": SCALAR,
    "deviation": SCALAR,
    "mass": SCALAR,
    "field": SCALAR,
}


@dataclass(frozen=True)
class Term:
    """A term of the pair sums.

    Attributes:
        name: as in C++; in capitals in ``plan`` and Triton.
        reads: names of ``FIELDS``.
        weights: by which of ``WEIGHTS`` it may be summed.
        kind: RATE and ACCELERATION, of which all combinations are compiled, or SINGLE: a pass of its own, or with the
            others of one of ``COMPANIES``.
    """

    name: str
    reads: tuple[str, ...] = ()
    weights: tuple[int, ...] = (BY_VOLUME,)
    kind: str = SINGLE


@dataclass(frozen=True)
class Output:
    """A sum over the partners of each particle.

    Attributes:
        name: field of ``Rates``, or of what else a backend returns.
        terms: names of the terms that fill it; where it is several, they add up.
        rank: SCALAR, VECTOR or MATRIX, (N,), (N, D) or (N, D, D).
        power: VALUE or SLOPE.
        times: number that the sum is multiplied by.
        own: whether it is multiplied by the particle's own factor, which turns the weights of a pass into those of
            the formula (csrc/rows.hpp).
    """

    name: str
    terms: tuple[str, ...]
    rank: int = SCALAR
    power: int = SLOPE
    times: int = 1
    own: bool = False


_EITHER = (BY_VOLUME, BY_MASS)

# The order is that of the flags: 1, 2, 4, ...; rates and accelerations come first, and each of them doubles the
# number of compiled passes. A new term that is not wanted in one loop with them is SINGLE, at the end.
TERMS = (
    Term("continuity", ("velocity",), _EITHER, RATE),
    Term("diffusion", ("deviation",), kind=RATE),
    Term("concentration", kind=RATE),
    Term("xsph", ("velocity", "inertia"), _EITHER, RATE),
    Term("pressure", ("stress",), _EITHER, ACCELERATION),
    Term("artificial", ("velocity", "inertia"), _EITHER, ACCELERATION),
    Term("laminar", ("velocity", "inverse"), _EITHER, ACCELERATION),
    Term("tensile", ("stress",), _EITHER, ACCELERATION),
    Term("shepard", ("mass",)),
    Term("renormalisation"),
    Term("laplacian", ("field",)),
    Term("gradient", ("deviation",)),
    Term("corrected_diffusion", ("deviation", "slope")),
    Term("moments", ("mass",)),
)
# further passes that are compiled: the exact gradient, and what an incompressible step asks for at once
COMPANIES = (
    ("gradient", "renormalisation"),
    ("continuity", "shepard"),
    ("continuity", "concentration", "shepard"),
    ("continuity", "concentration", "shepard", "laminar"),
)

# in the order in which a pass returns its sums
OUTPUTS = (
    Output("divergence", ("continuity",)),
    Output("diffusion", ("diffusion", "corrected_diffusion"), times=2),
    Output("concentration", ("concentration",), VECTOR),
    Output("xsph", ("xsph",), VECTOR, VALUE, times=2, own=True),
    Output("acceleration", ("pressure", "artificial", "laminar"), VECTOR, own=True),
    Output("shepard_volume", ("shepard",), power=VALUE),
    Output("shepard_mass", ("shepard",), power=VALUE),
    Output("renormalisation", ("renormalisation",), MATRIX),
    Output("laplacian", ("laplacian",), times=2, own=True),
    Output("diagonal", ("laplacian",), times=2, own=True),
    Output("gradient", ("gradient",), VECTOR),
    Output("moment_first", ("moments",), VECTOR, VALUE),
    Output("moment_second", ("moments",), MATRIX, VALUE),
    Output("moment_mass", ("moments",), VECTOR, VALUE),
)

FLAGS = {term.name: 1 << bit for bit, term in enumerate(TERMS)}


def flags(*names: str) -> int:
    """The sum of the terms' flags."""
    return sum(FLAGS[name] for name in names)


def of_kind(kind: str) -> int:
    """Flags of the terms of one kind."""
    return flags(*(term.name for term in TERMS if term.kind == kind))


def reading(field: str) -> int:
    """Flags of the terms that read one of ``FIELDS``."""
    return flags(*(term.name for term in TERMS if field in term.reads))


@lru_cache
def outputs_of(terms: int) -> tuple[Output, ...]:
    """What a pass with these flags returns, in order."""
    return tuple(output for output in OUTPUTS if flags(*output.terms) & terms)


def special_passes() -> tuple[int, ...]:
    """Flags of the compiled passes that are no combination of rates and accelerations."""
    return (
        *(FLAGS[term.name] for term in TERMS if term.kind == SINGLE),
        *(flags(*company) for company in COMPANIES),
    )
