"""The pair sums as one Triton kernel; terms are compile-time constants, what is absent is not in the loop.

A program works on a block of particles a that follow each other in cell order, so that its lanes read nearly
the same partners b.  A lane walks the runs of particles b in the rows of cells around it.  The formulas are
those of csrc/passes.hpp, with the same weights (see ``plan``).
"""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def kernel_shape(square, support, KERNEL: tl.constexpr):
    """w(q) and w'(q)/q for q^2 = ``square``; kernels in the order of ``plan.KERNEL_ORDER``."""
    if KERNEL == 5:
        value = tl.where(square < support * support, tl.exp(-0.5 * square), 0.0 * square)
        slope = -value
    else:
        q = tl.minimum(tl.sqrt(square), support)
        if KERNEL <= 2:
            t = tl.maximum(1.0 - 0.5 * q, 0.0 * q)
            t2 = t * t
            if KERNEL == 0:
                value = t2 * t2 * (1.0 + 2.0 * q)
                slope = -5.0 * t2 * t
            elif KERNEL == 1:
                value = t2 * t2 * t2 * (1.0 + q * (3.0 + 2.9166666666666665 * q))
                slope = -t2 * t2 * t * (4.666666666666667 + 11.666666666666666 * q)
            else:
                value = t2 * t2 * t2 * t2 * (1.0 + q * (4.0 + q * (6.25 + 4.0 * q)))
                slope = -t2 * t2 * t2 * t * (5.5 + q * (19.25 + 22.0 * q))
        elif KERNEL == 3:
            a = tl.maximum(2.0 - q, 0.0 * q)
            b = tl.maximum(1.0 - q, 0.0 * q)
            value = 0.25 * a * a * a - b * b * b
            slope = tl.where(q < 1.0, 2.25 * q - 3.0, -0.75 * a * a / tl.maximum(q, 0.5))
        elif KERNEL == 4:
            a = tl.maximum(3.0 - q, 0.0 * q)
            b = tl.maximum(2.0 - q, 0.0 * q)
            c = tl.maximum(1.0 - q, 0.0 * q)
            a4 = a * a * a * a
            b4 = b * b * b * b
            value = a4 * a - 6.0 * b4 * b + 15.0 * c * c * c * c * c
            outer = -5.0 * (a4 - 6.0 * b4) / tl.maximum(q, 0.5)
            slope = tl.where(q < 1.0, -120.0 + q * q * (120.0 - 50.0 * q), outer)
        else:
            t = tl.maximum(1.0 - q, 0.0 * q)
            value = t * t * t
            slope = -3.0 * t * t / tl.maximum(q, 1e-6)
    return value, slope


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
def load_row(fields, row, count, at, mask, other, WANTED: tl.constexpr):
    """A row of ``fields`` at particles, or ``other`` where no term wants it (and nothing is read)."""
    value = other + 0.0 * at
    if WANTED:
        value = tl.load(fields + row * count + at, mask=mask, other=other)
    return value


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
def central_push(
    stress,
    other,
    value,
    approach,
    viscosity,
    distance,
    PRESSURE: tl.constexpr,
    ARTIFICIAL: tl.constexpr,
    TENSILE: tl.constexpr,
    tensile,
):
    """Pressure and artificial viscosity of a pair along its gap, before the kernel's slope."""
    push = 0.0 * value
    if PRESSURE:
        push = stress + other
        if TENSILE:
            push += tensile * value * value * value * value * (tl.abs(stress) + tl.abs(other))
    if ARTIFICIAL:
        push -= viscosity * tl.minimum(approach, 0.0 * value) / distance
    return push


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
    JUMPS: tl.constexpr,
    APPROACH: tl.constexpr,
    CONTINUITY: tl.constexpr,
    DIFFUSION: tl.constexpr,
    CONCENTRATION: tl.constexpr,
    XSPH: tl.constexpr,
    PRESSURE: tl.constexpr,
    ARTIFICIAL: tl.constexpr,
    LAMINAR: tl.constexpr,
    TENSILE: tl.constexpr,
    SHEPARD: tl.constexpr,
    RENORMALISATION: tl.constexpr,
    LAPLACIAN: tl.constexpr,
    GRADIENT: tl.constexpr,
    CORRECTED_DIFFUSION: tl.constexpr,
    MOMENTS: tl.constexpr,
    SLOPE: tl.constexpr,
    WEIGHT: tl.constexpr,
    STRESS: tl.constexpr,
    INERTIA: tl.constexpr,
    INVERSE: tl.constexpr,
    DEVIATION: tl.constexpr,
    MASS: tl.constexpr,
    FIELD: tl.constexpr,
):
    """Sums of BLOCK particles; ``fields`` (F, count) and ``out`` (O, count) hold one quantity per row.

    WEIGHT ... FIELD are rows of ``fields`` (position first, then velocity); ``coefficients`` has five numbers
    per member: 1/h, 0.01 h^2, 2 h times the artificial viscosity, laminar viscosity, tensile coefficient.
    """
    RISES: tl.constexpr = (DIFFUSION or CORRECTED_DIFFUSION) or GRADIENT
    INERT: tl.constexpr = XSPH or ARTIFICIAL
    MASSES: tl.constexpr = SHEPARD or MOMENTS
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = a < count
    own = coefficients + 5 * tl.load(member + a, mask=live, other=0)
    inverse_length, epsilon = tl.load(own), tl.load(own + 1)
    artificial, laminar, tensile = tl.load(own + 2), tl.load(own + 3), tl.load(own + 4)
    # by address: a scalar argument would be rounded to float32
    period = (tl.load(periods), tl.load(periods + 1), tl.load(periods + 2))
    place = load_vector(fields, 0, count, a, live, D)
    zero = 0.0 * place[0]
    none = (zero, zero, zero)
    velocity, own_slope = none, none
    if JUMPS:
        velocity = load_vector(fields, D, count, a, live, D)
    if CORRECTED_DIFFUSION:
        own_slope = load_vector(fields, SLOPE, count, a, live, D)
    stress = zero
    if PRESSURE:
        stress = tl.load(own_stress + a, mask=live, other=0.0)
    inertia = load_row(fields, INERTIA, count, a, live, 1.0, INERT)
    inverse = load_row(fields, INVERSE, count, a, live, 1.0, LAMINAR)
    deviation = load_row(fields, DEVIATION, count, a, live, 0.0, RISES)
    field = load_row(fields, FIELD, count, a, live, 0.0, LAPLACIAN)

    divergence, spread, shepard_volume, shepard_mass, total, diagonal = zero, zero, zero, zero, zero, zero
    first, mass_first, drift, force = none, none, none, none
    second = (zero, zero, zero, zero, zero, zero)
    for r in range(RANGES):
        begin = tl.load(start + r * count + a, mask=live, other=0)
        last = tl.load(stop + r * count + a, mask=live, other=0)
        for step in range(0, tl.max(last - begin, axis=0)):
            b = begin + step
            here = b < last
            gap, square = separation(place, load_vector(fields, 0, count, b, here, D), period, PERIODIC, D)
            value, slope = kernel_shape(square * inverse_length * inverse_length, support, KERNEL)
            weight = tl.load(fields + WEIGHT * count + b, mask=here, other=0.0)
            slope = slope * weight
            distance = square + epsilon
            pair_inertia = inertia + load_row(fields, INERTIA, count, b, here, 1.0, INERT)
            rise = load_row(fields, DEVIATION, count, b, here, 0.0, RISES) - deviation
            mass = load_row(fields, MASS, count, b, here, 0.0, MASSES) * value
            jump, approach = none, zero
            if JUMPS:
                jump = vector_sum(velocity, -1.0, load_vector(fields, D, count, b, here, D))
            if APPROACH:
                approach = dot(jump, gap)
            if CONTINUITY:
                divergence -= slope * approach
            if DIFFUSION:
                spread -= slope * rise
            if CORRECTED_DIFFUSION:
                both = vector_sum(own_slope, 1.0, load_vector(fields, SLOPE, count, b, here, D))
                spread -= slope * (rise + 0.5 * dot(gap, both))
            if GRADIENT:
                drift = vector_sum(drift, slope * rise, gap)
            if MOMENTS:
                first = vector_sum(first, -weight * value, gap)
                mass_first = vector_sum(mass_first, -mass, gap)
                second = matrix_sum(second, weight * value, gap)
            if CONCENTRATION:
                first = vector_sum(first, slope, gap)
            if SHEPARD:
                shepard_volume += weight * value
                shepard_mass += mass
            if RENORMALISATION:
                second = matrix_sum(second, -slope, gap)
            if XSPH:
                drift = vector_sum(drift, -weight * value / pair_inertia, jump)
            if PRESSURE or ARTIFICIAL:
                other = load_row(fields, STRESS, count, b, here, 0.0, PRESSURE)
                push = central_push(
                    stress,
                    other,
                    value,
                    approach,
                    artificial,
                    pair_inertia * distance,
                    PRESSURE,
                    ARTIFICIAL,
                    TENSILE,
                    tensile,
                )
                force = vector_sum(force, -push * slope, gap)
            if LAMINAR:
                other = inverse + tl.load(fields + INVERSE * count + b, mask=here, other=1.0)
                force = vector_sum(force, laminar * slope * square / distance * other, jump)
            if LAPLACIAN:
                part = slope * square / distance
                diagonal -= part
                total -= part * (field - tl.load(fields + FIELD * count + b, mask=here, other=0.0))

    row = 0
    if CONTINUITY:
        row = store_scalar(out, row, count, a, live, divergence)
    if DIFFUSION:
        row = store_scalar(out, row, count, a, live, spread)
    if CONCENTRATION:
        row = store_vector(out, row, count, a, live, first, D)
    if XSPH:
        row = store_vector(out, row, count, a, live, drift, D)
    if (PRESSURE or ARTIFICIAL) or LAMINAR:
        row = store_vector(out, row, count, a, live, force, D)
    if SHEPARD:
        row = store_scalar(out, row, count, a, live, shepard_volume)
        row = store_scalar(out, row, count, a, live, shepard_mass)
    if RENORMALISATION:
        row = store_matrix(out, row, count, a, live, second, D)
    if LAPLACIAN:
        row = store_scalar(out, row, count, a, live, total)
        row = store_scalar(out, row, count, a, live, diagonal)
    if GRADIENT:
        row = store_vector(out, row, count, a, live, drift, D)
    if CORRECTED_DIFFUSION:
        row = store_scalar(out, row, count, a, live, spread)
    if MOMENTS:
        row = store_vector(out, row, count, a, live, first, D)
        row = store_matrix(out, row, count, a, live, second, D)
        row = store_vector(out, row, count, a, live, mass_first, D)
