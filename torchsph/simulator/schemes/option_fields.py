"""Numbers among the options of dataclasses: each finite, and of the kind that its field says."""

from __future__ import annotations

import math
from dataclasses import Field, fields
from typing import Any, ClassVar, Protocol

_KINDS = {"float": "a number", "int": "a whole number", "bool": "True or False"}


class Options(Protocol):
    """A dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


def check_numbers(options: Options) -> None:
    """Refuse an option that is not finite, or no number (no bool) where its field is one; None where that is allowed.

    Raises:
        ValueError: of the options, named by their class and field.
    """
    for part in fields(options):
        kinds = [kind.strip() for kind in str(part.type).split("|")]
        wanted = next((kind for kind in kinds if kind in _KINDS), None)
        value = getattr(options, part.name)
        if wanted is None or (value is None and "None" in kinds) or (len(kinds) > 2 and not _is_number(value)):
            continue  # no number, switched off, or of several kinds, which the class itself tells apart
        if wanted == "bool":
            fits = type(value).__name__ in ("bool", "bool_")  # of numpy too
        else:
            fits = _is_number(value) and math.isfinite(value) and (wanted == "float" or int(value) == value)
        if not fits:
            rule = _KINDS[wanted] if wanted == "bool" else f"{_KINDS[wanted]} that is finite"
            raise ValueError(f"{type(options).__name__}.{part.name} must be {rule}, got {value!r:.80}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) or (hasattr(value, "dtype") and getattr(value, "ndim", 1) == 0)
