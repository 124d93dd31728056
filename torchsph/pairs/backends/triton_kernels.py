"""The pair sums as one Triton kernel; terms are compile-time constants, what is absent is not in the loop.

A program works on a block of particles a that follow each other in cell order, so that its lanes read nearly
the same partners b.  A lane walks the runs of particles b in the rows of cells around it.  The formulas are
those of csrc/passes.hpp, with the same weights (see ``plan``).

Fields stand in rows of an array (3 D + 1 + scalars, count): position, velocity, slope, the weight of a partner,
the scalars of ``terms.FIELDS``. Rows that no term of a pass reads hold nothing and are not read. Sums are tuples
of one register for each of ``terms.OUTPUTS``; those that a pass does not fill never change, and the compiler
drops them from its loops.
"""

# mypy: allow-untyped-defs, allow-incomplete-defs
# (the language of Triton has no types)
from __future__ import annotations

import triton
import triton.language as tl

from ..terms import flags, reading
from .plan import SCALARS
from .triton_smoothing import smoothing_kernel

CONTINUITY = tl.constexpr(flags("continuity"))
DIFFUSION = tl.constexpr(flags("diffusion"))
CONCENTRATION = tl.constexpr(flags("concentration"))
XSPH = tl.constexpr(flags("xsph"))
PRESSURE = tl.constexpr(flags("pressure"))
ARTIFICIAL = tl.constexpr(flags("artificial"))
LAMINAR = tl.constexpr(flags("laminar"))
TENSILE = tl.constexpr(flags("tensile"))
SHEPARD = tl.constexpr(flags("shepard"))
RENORMALISATION = tl.constexpr(flags("renormalisation"))
LAPLACIAN = tl.constexpr(flags("laplacian"))
GRADIENT = tl.constexpr(flags("gradient"))
CORRECTED_DIFFUSION = tl.constexpr(flags("corrected_diffusion"))
MOMENTS = tl.constexpr(flags("moments"))

STRESS = tl.constexpr(SCALARS.index("stress"))
INERTIA = tl.constexpr(SCALARS.index("inertia"))
INVERSE = tl.constexpr(SCALARS.index("inverse"))
DEVIATION = tl.constexpr(SCALARS.index("deviation"))
MASS = tl.constexpr(SCALARS.index("mass"))
FIELD = tl.constexpr(SCALARS.index("field"))
# the terms that read each field
VELOCITY_READERS = tl.constexpr(reading("velocity"))
SLOPE_READERS = tl.constexpr(reading("slope"))
STRESS_READERS = tl.constexpr(reading("stress"))
INERTIA_READERS = tl.constexpr(reading("inertia"))
INVERSE_READERS = tl.constexpr(reading("inverse"))
DEVIATION_READERS = tl.constexpr(reading("deviation"))
MASS_READERS = tl.constexpr(reading("mass"))
FIELD_READERS = tl.constexpr(reading("field"))


@triton.jit
def nearest(gap, period, PERIODIC: tl.constexpr):
    """The nearest image of a separation; ``period`` is infinite where the axis is not periodic."""
    if PERIODIC:
        turns = tl.floor(gap / period + 0.5)
        gap = gap - tl.where(turns == 0.0, 0.0 * gap, turns * period)
    return gap


@triton.jit
def load_vector(fields, row, count, at, mask, D: tl.constexpr):
    """Rows ``row`` to ``row + D`` of ``fields`` at particles; the third component of a plane is 0."""
    x = tl.load(fields + row * count + at, mask=mask, other=0.0)
    y = tl.load(fields + (row + 1) * count + at, mask=mask, other=0.0)
    z = 0.0 * x
    if D == 3:
        z = tl.load(fields + (row + 2) * count + at, mask=mask, other=0.0)
    return x, y, z


@triton.jit
def dot(a, b):
    """Scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def vector_sum(total, factor, a):
    """total + factor a."""
    return total[0] + factor * a[0], total[1] + factor * a[1], total[2] + factor * a[2]


@triton.jit
def matrix_sum(total, factor, a):
    """total + factor a (x) a, for the entries xx, xy, xz, yy, yz, zz of a symmetric matrix."""
    x = factor * a[0]
    y = factor * a[1]
    z = factor * a[2]
    return (
        total[0] + x * a[0],
        total[1] + x * a[1],
        total[2] + x * a[2],
        total[3] + y * a[1],
        total[4] + y * a[2],
        total[5] + z * a[2],
    )


@triton.jit
def store_scalar(out, row, count, a, live, value):
    """Write a row of ``out``; the next free one."""
    tl.store(out + row * count + a, value, mask=live)
    return row + 1


@triton.jit
def store_vector(out, row, count, a, live, vector, D: tl.constexpr):
    """Write the components into rows of ``out``; the next free row."""
    tl.store(out + row * count + a, vector[0], mask=live)
    tl.store(out + (row + 1) * count + a, vector[1], mask=live)
    if D == 3:
        tl.store(out + (row + 2) * count + a, vector[2], mask=live)
    return row + D


@triton.jit
def store_matrix(out, row, count, a, live, matrix, D: tl.constexpr):
    """Write a symmetric matrix, row by row; the next free row of ``out``."""
    tl.store(out + row * count + a, matrix[0], mask=live)
    tl.store(out + (row + 1) * count + a, matrix[1], mask=live)
    tl.store(out + (row + D) * count + a, matrix[1], mask=live)
    tl.store(out + (row + D + 1) * count + a, matrix[3], mask=live)
    if D == 3:
        tl.store(out + (row + 2) * count + a, matrix[2], mask=live)
        tl.store(out + (row + 5) * count + a, matrix[4], mask=live)
        tl.store(out + (row + 6) * count + a, matrix[2], mask=live)
        tl.store(out + (row + 7) * count + a, matrix[4], mask=live)
        tl.store(out + (row + 8) * count + a, matrix[5], mask=live)
    return row + D * D


@triton.jit
def separation(place, other, period, PERIODIC: tl.constexpr, D: tl.constexpr):
    """Gap x_a - x_b of the nearest images, and its square."""
    x = nearest(place[0] - other[0], period[0], PERIODIC)
    y = nearest(place[1] - other[1], period[1], PERIODIC)
    z = place[2] - other[2]
    square = x * x + y * y
    if D == 3:
        z = nearest(z, period[2], PERIODIC)
        square += z * z
    return (x, y, z), square


@triton.jit
def load_scalar(fields, count, at, mask, other, SCALAR: tl.constexpr, D: tl.constexpr, WANTED: tl.constexpr):
    """One of the scalars at particles, or ``other`` where no term wants it (and nothing is read)."""
    value = other + 0.0 * at
    if WANTED:
        value = tl.load(fields + (3 * D + 1 + SCALAR) * count + at, mask=mask, other=other)
    return value


@triton.jit
def particle_fields(fields, count, at, mask, place, D: tl.constexpr, TERMS: tl.constexpr):
    """What the terms read of particles, neutral where there is none: no 1 / (k_a + k_b) may be infinite."""
    zero = 0.0 * place[0]
    velocity = (zero, zero, zero)
    slope = (zero, zero, zero)
    if VELOCITY_READERS & TERMS:
        velocity = load_vector(fields, D, count, at, mask, D)
    if SLOPE_READERS & TERMS:
        slope = load_vector(fields, 2 * D, count, at, mask, D)
    inertia = load_scalar(fields, count, at, mask, 1.0, INERTIA, D, INERTIA_READERS & TERMS)
    inverse = load_scalar(fields, count, at, mask, 1.0, INVERSE, D, INVERSE_READERS & TERMS)
    deviation = load_scalar(fields, count, at, mask, 0.0, DEVIATION, D, DEVIATION_READERS & TERMS)
    field = load_scalar(fields, count, at, mask, 0.0, FIELD, D, FIELD_READERS & TERMS)
    return velocity, slope, inertia, inverse, deviation, field


@triton.jit
def add_rates(sums, gap, jump, value, slope, weight, inertia, TERMS: tl.constexpr):
    """Continuity, concentration and XSPH of a pair, and what makes gradients exact."""
    divergence, concentration, xsph, renormalisation = sums
    if CONTINUITY & TERMS:
        divergence -= slope * dot(jump, gap)
    if CONCENTRATION & TERMS:
        concentration = vector_sum(concentration, slope, gap)
    if XSPH & TERMS:
        xsph = vector_sum(xsph, -weight * value / inertia, jump)
    if RENORMALISATION & TERMS:
        renormalisation = matrix_sum(renormalisation, -slope, gap)
    return divergence, concentration, xsph, renormalisation


@triton.jit
def add_differences(sums, gap, slope, rise, slope_sum, TERMS: tl.constexpr):
    """Terms of the difference of the two densities."""
    diffusion, gradient = sums
    if DIFFUSION & TERMS:
        diffusion -= slope * rise
    if CORRECTED_DIFFUSION & TERMS:
        diffusion -= slope * (rise + 0.5 * dot(gap, slope_sum))
    if GRADIENT & TERMS:
        gradient = vector_sum(gradient, slope * rise, gap)
    return diffusion, gradient


@triton.jit
def add_fillings(sums, gap, value, weight, mass, TERMS: tl.constexpr):
    """How particles fill the kernel: Shepard's sums and the moments."""
    shepard_volume, shepard_mass, moment_first, moment_second, moment_mass = sums
    if SHEPARD & TERMS:
        shepard_volume += weight * value
        shepard_mass += mass * value
    if MOMENTS & TERMS:
        moment_first = vector_sum(moment_first, -weight * value, gap)
        moment_mass = vector_sum(moment_mass, -mass * value, gap)
        moment_second = matrix_sum(moment_second, weight * value, gap)
    return shepard_volume, shepard_mass, moment_first, moment_second, moment_mass


@triton.jit
def add_forces(
    acceleration, gap, jump, square, distance, value, slope, stress, other, inertia, inverse, own, TERMS: tl.constexpr
):
    """Pressure and viscosities of a pair; ``own``: artificial, laminar and tensile coefficient of a."""
    if (PRESSURE | ARTIFICIAL) & TERMS:
        push = 0.0 * value
        if PRESSURE & TERMS:
            push = stress + other
            if TENSILE & TERMS:
                push += own[2] * value * value * value * value * (tl.abs(stress) + tl.abs(other))
        if ARTIFICIAL & TERMS:
            push -= own[0] * tl.minimum(dot(jump, gap), 0.0 * value) / (inertia * distance)
        acceleration = vector_sum(acceleration, -push * slope, gap)
    if LAMINAR & TERMS:
        acceleration = vector_sum(acceleration, own[1] * slope * square / distance * inverse, jump)
    return acceleration


@triton.jit
def add_laplacian(sums, square, distance, slope, drop, TERMS: tl.constexpr):
    """The Laplacian of a field and its diagonal."""
    laplacian, diagonal = sums
    if LAPLACIAN & TERMS:
        part = slope * square / distance
        diagonal -= part
        laplacian -= part * drop
    return laplacian, diagonal


@triton.jit
def store_sums(
    out, count, a, live, rates, differences, fillings, acceleration, images, D: tl.constexpr, TERMS: tl.constexpr
):
    """Write the sums that the terms fill, in the order of ``terms.OUTPUTS``."""
    divergence, concentration, xsph, renormalisation = rates
    diffusion, gradient = differences
    shepard_volume, shepard_mass, moment_first, moment_second, moment_mass = fillings
    row = 0
    if CONTINUITY & TERMS:
        row = store_scalar(out, row, count, a, live, divergence)
    if (DIFFUSION | CORRECTED_DIFFUSION) & TERMS:
        row = store_scalar(out, row, count, a, live, diffusion)
    if CONCENTRATION & TERMS:
        row = store_vector(out, row, count, a, live, concentration, D)
    if XSPH & TERMS:
        row = store_vector(out, row, count, a, live, xsph, D)
    if (PRESSURE | ARTIFICIAL | LAMINAR) & TERMS:
        row = store_vector(out, row, count, a, live, acceleration, D)
    if SHEPARD & TERMS:
        row = store_scalar(out, row, count, a, live, shepard_volume)
        row = store_scalar(out, row, count, a, live, shepard_mass)
    if RENORMALISATION & TERMS:
        row = store_matrix(out, row, count, a, live, renormalisation, D)
    if LAPLACIAN & TERMS:
        row = store_scalar(out, row, count, a, live, images[0])
        row = store_scalar(out, row, count, a, live, images[1])
    if GRADIENT & TERMS:
        row = store_vector(out, row, count, a, live, gradient, D)
    if MOMENTS & TERMS:
        row = store_vector(out, row, count, a, live, moment_first, D)
        row = store_matrix(out, row, count, a, live, moment_second, D)
        row = store_vector(out, row, count, a, live, moment_mass, D)


@triton.jit
def member_coefficients(coefficients, member, a, live):
    """1/h, 0.01 h^2, and the artificial, laminar and tensile coefficients of the particles a."""
    own = coefficients + 5 * tl.load(member + a, mask=live, other=0)
    return tl.load(own), tl.load(own + 1), (tl.load(own + 2), tl.load(own + 3), tl.load(own + 4))


@triton.jit
def no_sums(zero):
    """Registers before the first pair, in the groups of the functions that add to them."""
    vector = (zero, zero, zero)
    matrix = (zero, zero, zero, zero, zero, zero)
    return (zero, vector, vector, matrix), (zero, vector), (zero, zero, vector, matrix, vector), vector, (zero, zero)


@triton.jit
def pair_sums(
    fields,
    own_stress,
    out,
    coefficients,
    member,
    start,
    stop,
    periods,
    support,
    count,
    D: tl.constexpr,
    KERNEL: tl.constexpr,
    RANGES: tl.constexpr,
    PERIODIC: tl.constexpr,
    BLOCK: tl.constexpr,
    TERMS: tl.constexpr,
):
    """Sums of BLOCK particles; ``fields`` (F, count) and ``out`` (O, count) hold one quantity per row.

    ``coefficients`` has five numbers per member: 1/h, 0.01 h^2, 2 h times the artificial viscosity, laminar viscosity,
    tensile coefficient.
    """
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = a < count
    inverse_length, epsilon, viscosities = member_coefficients(coefficients, member, a, live)
    # by address: a scalar argument would be rounded to float32
    period = (tl.load(periods), tl.load(periods + 1), tl.load(periods + 2))
    place = load_vector(fields, 0, count, a, live, D)
    velocity, own_slope, inertia, inverse, deviation, field = particle_fields(fields, count, a, live, place, D, TERMS)
    zero = 0.0 * place[0]
    stress = zero
    if STRESS_READERS & TERMS:
        stress = tl.load(own_stress + a, mask=live, other=0.0)
    rates, differences, fillings, acceleration, images = no_sums(zero)
    for r in range(RANGES):
        begin = tl.load(start + r * count + a, mask=live, other=0)
        last = tl.load(stop + r * count + a, mask=live, other=0)
        for step in range(0, tl.max(last - begin, axis=0)):
            b = begin + step
            here = b < last
            gap, square = separation(place, load_vector(fields, 0, count, b, here, D), period, PERIODIC, D)
            value, slope = smoothing_kernel(square * inverse_length * inverse_length, support, KERNEL)
            weight = tl.load(fields + 3 * D * count + b, mask=here, other=0.0)
            slope = slope * weight
            distance = square + epsilon
            v, s, k, i, d, f = particle_fields(fields, count, b, here, gap, D, TERMS)
            mass = load_scalar(fields, count, b, here, 0.0, MASS, D, MASS_READERS & TERMS)
            other = load_scalar(fields, count, b, here, 0.0, STRESS, D, STRESS_READERS & TERMS)
            jump = vector_sum(velocity, -1.0, v)
            k, i = inertia + k, inverse + i
            rates = add_rates(rates, gap, jump, value, slope, weight, k, TERMS)
            differences = add_differences(differences, gap, slope, d - deviation, vector_sum(own_slope, 1.0, s), TERMS)
            fillings = add_fillings(fillings, gap, value, weight, mass, TERMS)
            acceleration = add_forces(
                acceleration, gap, jump, square, distance, value, slope, stress, other, k, i, viscosities, TERMS
            )
            images = add_laplacian(images, square, distance, slope, field - f, TERMS)
    store_sums(out, count, a, live, rates, differences, fillings, acceleration, images, D, TERMS)
