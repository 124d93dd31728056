"""What must be there: optional sums, coefficients and fields where a scheme cannot do without them."""

from __future__ import annotations

from typing import TypeVar

_Value = TypeVar("_Value")


def required(value: _Value | None, name: str) -> _Value:
    """``value``, which must not be None here.

    Raises:
        ValueError: it is; ``name`` says what is missing.
    """
    if value is None:
        raise ValueError(f"{name} is needed here, but was not asked for or is switched off in this scheme")
    return value
