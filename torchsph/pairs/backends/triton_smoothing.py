"""The smoothing kernels in Triton: the formulas of csrc/smoothing.hpp, chosen when a kernel is compiled."""

# mypy: allow-untyped-defs, allow-incomplete-defs
# (the language of Triton has no types)
from __future__ import annotations

import triton
import triton.language as tl

from ..smoothing_kernels import NUMBERS

GAUSSIAN = tl.constexpr(NUMBERS["gaussian"])
CUBIC = tl.constexpr(NUMBERS["cubic"])
QUINTIC = tl.constexpr(NUMBERS["quintic"])
WENDLAND_C2 = tl.constexpr(NUMBERS["wendland_c2"])
WENDLAND_C4 = tl.constexpr(NUMBERS["wendland_c4"])
WENDLAND_C6 = tl.constexpr(NUMBERS["wendland_c6"])
SPIKY = tl.constexpr(NUMBERS["spiky"])


@triton.jit
def polynomial_kernel(q, KERNEL: tl.constexpr):
    """w(q) and w'(q)/q of the smoothing kernels that are piecewise polynomials, for q inside the support."""
    if KERNEL == CUBIC:
        a = tl.maximum(2.0 - q, 0.0 * q)
        b = tl.maximum(1.0 - q, 0.0 * q)
        value = 0.25 * a * a * a - b * b * b
        slope = tl.where(q < 1.0, 2.25 * q - 3.0, -0.75 * a * a / tl.maximum(q, 0.5))
    elif KERNEL == QUINTIC:
        a = tl.maximum(3.0 - q, 0.0 * q)
        b = tl.maximum(2.0 - q, 0.0 * q)
        c = tl.maximum(1.0 - q, 0.0 * q)
        a4 = a * a * a * a
        b4 = b * b * b * b
        value = a4 * a - 6.0 * b4 * b + 15.0 * c * c * c * c * c
        outer = -5.0 * (a4 - 6.0 * b4) / tl.maximum(q, 0.5)
        slope = tl.where(q < 1.0, -120.0 + q * q * (120.0 - 50.0 * q), outer)
    elif KERNEL == SPIKY:
        t = tl.maximum(1.0 - q, 0.0 * q)
        value = t * t * t
        slope = -3.0 * t * t / tl.maximum(q, 1e-6)
    else:
        t = tl.maximum(1.0 - 0.5 * q, 0.0 * q)
        t2 = t * t
        if KERNEL == WENDLAND_C2:
            value = t2 * t2 * (1.0 + 2.0 * q)
            slope = -5.0 * t2 * t
        elif KERNEL == WENDLAND_C4:
            value = t2 * t2 * t2 * (1.0 + q * (3.0 + 2.9166666666666665 * q))
            slope = -t2 * t2 * t * (4.666666666666667 + 11.666666666666666 * q)
        else:
            tl.static_assert(KERNEL == WENDLAND_C6, "a smoothing kernel without a formula here")
            value = t2 * t2 * t2 * t2 * (1.0 + q * (4.0 + q * (6.25 + 4.0 * q)))
            slope = -t2 * t2 * t2 * t * (5.5 + q * (19.25 + 22.0 * q))
    return value, slope


@triton.jit
def smoothing_kernel(square, support, KERNEL: tl.constexpr):
    """w(q) and w'(q)/q for q^2 = ``square``."""
    if KERNEL == GAUSSIAN:
        value = tl.where(square < support * support, tl.exp(-0.5 * square), 0.0 * square)
        slope = -value
    else:
        value, slope = polynomial_kernel(tl.minimum(tl.sqrt(square), support), KERNEL)
    return value, slope
