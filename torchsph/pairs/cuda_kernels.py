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
def store_vector(out, row, count, a, live, x, y, z, D: tl.constexpr):
    """Write the components into rows of ``out``; the next free row."""
    tl.store(out + row * count + a, x, mask=live)
    tl.store(out + (row + 1) * count + a, y, mask=live)
    if D == 3:
        tl.store(out + (row + 2) * count + a, z, mask=live)
    return row + D


@triton.jit
def store_matrix(out, row, count, a, live, xx, xy, xz, yy, yz, zz, D: tl.constexpr):
    """Write a symmetric matrix, row by row; the next free row of ``out``."""
    tl.store(out + row * count + a, xx, mask=live)
    tl.store(out + (row + 1) * count + a, xy, mask=live)
    tl.store(out + (row + D) * count + a, xy, mask=live)
    tl.store(out + (row + D + 1) * count + a, yy, mask=live)
    if D == 3:
        tl.store(out + (row + 2) * count + a, xz, mask=live)
        tl.store(out + (row + 5) * count + a, yz, mask=live)
        tl.store(out + (row + 6) * count + a, xz, mask=live)
        tl.store(out + (row + 7) * count + a, yz, mask=live)
        tl.store(out + (row + 8) * count + a, zz, mask=live)
    return row + D * D


@triton.jit
def pair_sums(
    fields, own_stress, out, coefficients, member, start, stop, periods, support, count,
    D: tl.constexpr, KERNEL: tl.constexpr, RANGES: tl.constexpr, PERIODIC: tl.constexpr, BLOCK: tl.constexpr,
    JUMPS: tl.constexpr, APPROACH: tl.constexpr, CONTINUITY: tl.constexpr, DIFFUSION: tl.constexpr,
    CONCENTRATION: tl.constexpr, XSPH: tl.constexpr, PRESSURE: tl.constexpr, ARTIFICIAL: tl.constexpr,
    LAMINAR: tl.constexpr, TENSILE: tl.constexpr, SHEPARD: tl.constexpr, RENORMALISATION: tl.constexpr,
    LAPLACIAN: tl.constexpr, GRADIENT: tl.constexpr, CORRECTED_DIFFUSION: tl.constexpr, MOMENTS: tl.constexpr,
    SLOPE: tl.constexpr, WEIGHT: tl.constexpr, STRESS: tl.constexpr, INERTIA: tl.constexpr,
    INVERSE: tl.constexpr, DEVIATION: tl.constexpr, MASS: tl.constexpr, FIELD: tl.constexpr,
):  # fmt: skip
    """Sums of BLOCK particles; ``fields`` (F, count) and ``out`` (O, count) hold one quantity per row.

    WEIGHT ... FIELD are rows of ``fields`` (position first, then velocity); ``coefficients`` has five numbers
    per member: 1/h, 0.01 h^2, 2 h times the artificial viscosity, laminar viscosity, tensile coefficient.
    """
    a = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = a < count
    xa = tl.load(fields + a, mask=live, other=0.0)
    ya = tl.load(fields + count + a, mask=live, other=0.0)
    own = tl.load(member + a, mask=live, other=0)
    inverse_length = tl.load(coefficients + 5 * own)
    epsilon = tl.load(coefficients + 5 * own + 1)
    zero = 0.0 * xa
    px = tl.load(periods)  # by address: a scalar argument would be rounded to float32
    py = tl.load(periods + 1)
    pz = tl.load(periods + 2)
    za = zero
    ua = zero
    va = zero
    wa = zero
    if D == 3:
        za = tl.load(fields + 2 * count + a, mask=live, other=0.0)
    if JUMPS:
        ua = tl.load(fields + D * count + a, mask=live, other=0.0)
        va = tl.load(fields + (D + 1) * count + a, mask=live, other=0.0)
        if D == 3:
            wa = tl.load(fields + (D + 2) * count + a, mask=live, other=0.0)
    stress = zero
    if PRESSURE:
        stress = tl.load(own_stress + a, mask=live, other=0.0)
    inertia = zero
    if XSPH or ARTIFICIAL:
        inertia = tl.load(fields + INERTIA * count + a, mask=live, other=1.0)
    inverse = zero
    if LAMINAR:
        inverse = tl.load(fields + INVERSE * count + a, mask=live, other=1.0)
    deviation = zero
    if DIFFUSION or CORRECTED_DIFFUSION or GRADIENT:
        deviation = tl.load(fields + DEVIATION * count + a, mask=live, other=0.0)
    slope_x = zero
    slope_y = zero
    slope_z = zero
    if CORRECTED_DIFFUSION:
        slope_x = tl.load(fields + SLOPE * count + a, mask=live, other=0.0)
        slope_y = tl.load(fields + (SLOPE + 1) * count + a, mask=live, other=0.0)
        if D == 3:
            slope_z = tl.load(fields + (SLOPE + 2) * count + a, mask=live, other=0.0)
    field = zero
    if LAPLACIAN:
        field = tl.load(fields + FIELD * count + a, mask=live, other=0.0)
    artificial = tl.load(coefficients + 5 * own + 2)
    laminar = tl.load(coefficients + 5 * own + 3)
    tensile = tl.load(coefficients + 5 * own + 4)

    divergence = zero
    spread = zero
    first_x = zero
    first_y = zero
    first_z = zero
    drift_x = zero
    drift_y = zero
    drift_z = zero
    force_x = zero
    force_y = zero
    force_z = zero
    shepard_volume = zero
    shepard_mass = zero
    nxx = zero
    nxy = zero
    nxz = zero
    nyy = zero
    nyz = zero
    nzz = zero
    mass_x = zero
    mass_y = zero
    mass_z = zero
    total = zero
    diagonal = zero

    for r in range(RANGES):
        first = tl.load(start + r * count + a, mask=live, other=0)
        last = tl.load(stop + r * count + a, mask=live, other=0)
        longest = tl.max(last - first, axis=0)
        for step in range(0, longest):
            b = first + step
            here = b < last
            x = nearest(xa - tl.load(fields + b, mask=here, other=0.0), px, PERIODIC)
            y = nearest(ya - tl.load(fields + count + b, mask=here, other=0.0), py, PERIODIC)
            square = x * x + y * y
            z = zero
            if D == 3:
                z = nearest(za - tl.load(fields + 2 * count + b, mask=here, other=0.0), pz, PERIODIC)
                square += z * z
            value, slope = kernel_shape(square * inverse_length * inverse_length, support, KERNEL)
            weight = tl.load(fields + WEIGHT * count + b, mask=here, other=0.0)
            slope = slope * weight
            u = zero
            v = zero
            w = zero
            if JUMPS:
                u = ua - tl.load(fields + D * count + b, mask=here, other=0.0)
                v = va - tl.load(fields + (D + 1) * count + b, mask=here, other=0.0)
                if D == 3:
                    w = wa - tl.load(fields + (D + 2) * count + b, mask=here, other=0.0)
            approach = zero
            if APPROACH:
                approach = u * x + v * y + w * z
            if CONTINUITY:
                divergence -= slope * approach
            if DIFFUSION:
                spread += slope * (deviation - tl.load(fields + DEVIATION * count + b, mask=here, other=0.0))
            if CORRECTED_DIFFUSION:
                linear = x * (slope_x + tl.load(fields + SLOPE * count + b, mask=here, other=0.0))
                linear += y * (slope_y + tl.load(fields + (SLOPE + 1) * count + b, mask=here, other=0.0))
                if D == 3:
                    linear += z * (slope_z + tl.load(fields + (SLOPE + 2) * count + b, mask=here, other=0.0))
                drop = deviation - tl.load(fields + DEVIATION * count + b, mask=here, other=0.0)
                spread += slope * (drop - 0.5 * linear)
            if GRADIENT:
                rise = tl.load(fields + DEVIATION * count + b, mask=here, other=0.0) - deviation
                drift_x += slope * rise * x
                drift_y += slope * rise * y
                drift_z += slope * rise * z
            if MOMENTS:
                volume = weight * value
                mass = tl.load(fields + MASS * count + b, mask=here, other=0.0) * value
                first_x -= volume * x
                first_y -= volume * y
                first_z -= volume * z
                mass_x -= mass * x
                mass_y -= mass * y
                mass_z -= mass * z
                nxx += volume * x * x
                nxy += volume * x * y
                nxz += volume * x * z
                nyy += volume * y * y
                nyz += volume * y * z
                nzz += volume * z * z
            if CONCENTRATION:
                first_x += slope * x
                first_y += slope * y
                first_z += slope * z
            if SHEPARD:
                shepard_volume += weight * value
                shepard_mass += tl.load(fields + MASS * count + b, mask=here, other=0.0) * value
            if RENORMALISATION:
                nxx -= slope * x * x
                nxy -= slope * x * y
                nxz -= slope * x * z
                nyy -= slope * y * y
                nyz -= slope * y * z
                nzz -= slope * z * z
            pair_inertia = zero + 1.0
            if XSPH or ARTIFICIAL:
                pair_inertia = inertia + tl.load(fields + INERTIA * count + b, mask=here, other=1.0)
            distance = square + epsilon
            if XSPH:
                pull = weight * value / pair_inertia
                drift_x -= pull * u
                drift_y -= pull * v
                drift_z -= pull * w
            if PRESSURE or ARTIFICIAL:
                push = zero
                if PRESSURE:
                    other = tl.load(fields + STRESS * count + b, mask=here, other=0.0)
                    push = stress + other
                    if TENSILE:
                        push += tensile * value * value * value * value * (tl.abs(stress) + tl.abs(other))
                if ARTIFICIAL:
                    push -= artificial * tl.minimum(approach, zero) / (pair_inertia * distance)
                push = push * slope
                force_x -= push * x
                force_y -= push * y
                force_z -= push * z
            if LAMINAR:
                other = inverse + tl.load(fields + INVERSE * count + b, mask=here, other=1.0)
                rate = laminar * slope * square / distance * other
                force_x += rate * u
                force_y += rate * v
                force_z += rate * w
            if LAPLACIAN:
                part = slope * square / distance
                diagonal -= part
                total -= part * (field - tl.load(fields + FIELD * count + b, mask=here, other=0.0))

    row = 0
    if CONTINUITY:
        tl.store(out + row * count + a, divergence, mask=live)
        row += 1
    if DIFFUSION:
        tl.store(out + row * count + a, spread, mask=live)
        row += 1
    if CONCENTRATION:
        row = store_vector(out, row, count, a, live, first_x, first_y, first_z, D)
    if XSPH:
        row = store_vector(out, row, count, a, live, drift_x, drift_y, drift_z, D)
    if PRESSURE or ARTIFICIAL or LAMINAR:
        row = store_vector(out, row, count, a, live, force_x, force_y, force_z, D)
    if SHEPARD:
        tl.store(out + row * count + a, shepard_volume, mask=live)
        tl.store(out + (row + 1) * count + a, shepard_mass, mask=live)
        row += 2
    if RENORMALISATION:
        row = store_matrix(out, row, count, a, live, nxx, nxy, nxz, nyy, nyz, nzz, D)
    if LAPLACIAN:
        tl.store(out + row * count + a, total, mask=live)
        tl.store(out + (row + 1) * count + a, diagonal, mask=live)
        row += 2
    if GRADIENT:
        row = store_vector(out, row, count, a, live, drift_x, drift_y, drift_z, D)
    if CORRECTED_DIFFUSION:
        tl.store(out + row * count + a, spread, mask=live)
        row += 1
    if MOMENTS:
        row = store_vector(out, row, count, a, live, first_x, first_y, first_z, D)
        row = store_matrix(out, row, count, a, live, nxx, nxy, nxz, nyy, nyz, nzz, D)
        row = store_vector(out, row, count, a, live, mass_x, mass_y, mass_z, D)
