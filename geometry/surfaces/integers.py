"""Numbers as a narrower type, or a message: 300 never becomes 44 without a word."""

from __future__ import annotations

from typing import Any

import numpy as np


def narrowed(values: Any, kind: type) -> np.ndarray:
    """Values as an array of a type that holds every one of them.

    Args:
        values: an array, or what numpy makes one of.
        kind: a NumPy type: bool, integers, or floating point (which takes any real number).

    Returns:
        The array; the same one where it has that type already.

    Raises:
        ValueError: a value is no real number, or none that the type holds; says which are allowed.
    """
    array = np.asarray(values)
    if array.dtype == kind:
        return array
    if array.dtype.kind not in "fiub":
        try:
            array = np.asarray(values, np.float64)
        except (TypeError, ValueError) as fault:
            raise ValueError(f"must hold real numbers, not {array.dtype}") from fault
        if np.asarray(values).dtype.kind == "c":
            raise ValueError(f"must hold real numbers, not {np.asarray(values).dtype}")
    if np.dtype(kind).kind == "f":
        with np.errstate(over="ignore"):  # what is too large for float32 becomes inf, which the rules then report
            return array.astype(kind)
    refuse_changed(array, kind)
    return array.astype(kind)


def refuse_changed(array: np.ndarray, kind: type) -> None:
    """Refuse what a conversion to a whole or true-or-false type would change without a word.

    Args:
        array: real numbers.
        kind: a NumPy type: bool or integers.

    Raises:
        ValueError: a value is out of range, or no whole number.
    """
    lower, upper = (0, 1) if kind is np.bool_ else (np.iinfo(kind).min, np.iinfo(kind).max)
    if array.size and not ((array >= lower) & (array <= upper)).all():
        meaning = "0 and 1 only" if kind is np.bool_ else f"integers from {lower} to {upper}"
        raise ValueError(f"must hold {meaning}, not {array.min()} to {array.max()}")
    if array.dtype.kind == "f" and (array != np.rint(array)).any():
        raise ValueError("must hold integers" if kind is not np.bool_ else "must hold 0 and 1 only")


def region_number(name: str, value: float) -> int:
    """A number of a region, from 0 to 255.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(value, int | float | np.number) or value not in range(256):
        raise ValueError(f"{name} must be a whole number from 0 to 255, not {value!r:.80}")
    return int(value)
