"""Numbers on their way into a page: rounded to 16 bits, as text."""

from __future__ import annotations

import base64
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

STEPS = 32000
"""Steps from 0 to the largest value; what is no number is `NONE`."""
NONE = -32768


class Packed(TypedDict):
    """An array in a page: `values` times `step` plus `base`."""

    shape: list[int]
    kind: str
    step: float
    base: float
    values: str


def packed(array: ArrayLike) -> Packed:
    """An array of reals as signed 16-bit numbers around 0, so that 0 stays 0 and signs stay signs."""
    values = np.asarray(array, np.float64)
    known = np.isfinite(values)
    largest = float(np.abs(values[known]).max(initial=0.0))
    step = largest / STEPS if largest > 0 else 1.0
    rounded = np.where(known, np.round(np.where(known, values, 0.0) / step), NONE)
    return _as_text(rounded.astype("<i2"), "int16", step, 0.0)


def packed_places(array: ArrayLike) -> Packed:
    """An array of places as unsigned 16-bit numbers from its least to its largest."""
    values = np.asarray(array, np.float64)
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
    step = (high - low) / 65535 if high > low else 1.0
    return _as_text(np.round((values - low) / step).astype("<u2"), "uint16", step, low)


def packed_numbers(array: ArrayLike) -> Packed:
    """An array of whole numbers from 0 to 255."""
    return _as_text(np.asarray(array).astype(np.uint8), "uint8", 1.0, 0.0)


def _as_text(numbers: np.ndarray, kind: str, step: float, base: float) -> Packed:
    text = base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")
    return {"shape": list(numbers.shape), "kind": kind, "step": step, "base": base, "values": text}
