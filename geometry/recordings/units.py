"""Names of units, as files spell them, and what they are in SI."""

from __future__ import annotations

LENGTH = {
    "m": 1.0,
    "metre": 1.0,
    "meter": 1.0,
    "metres": 1.0,
    "meters": 1.0,
    "dm": 1e-1,
    "cm": 1e-2,
    "centimeter": 1e-2,
    "mm": 1e-3,
    "millimetre": 1e-3,
    "millimeter": 1e-3,
    "millimeters": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "μm": 1e-6,
    "micron": 1e-6,
    "micrometer": 1e-6,
}
TIME = {
    "s": 1.0,
    "sec": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "millisecond": 1e-3,
    "milliseconds": 1e-3,
    "us": 1e-6,
    "µs": 1e-6,
    "μs": 1e-6,
    "microsecond": 1e-6,
    "min": 60.0,
}
OTHER = {"pressure": {"pa": 1.0, "kpa": 1e3, "mmhg": 133.322387415, "hpa": 1e2}}


def factor(text: str, quantity: str) -> float:
    """SI units per unit of a name: `factor("cm/s", "velocity")` is .01.

    Args:
        text: as in files: `mm`, `cm/s`, `m s-1`, `mm.s^-1`, `m*s**-1`; or a number, which is taken as it is.
        quantity: length, time, velocity or pressure.

    Raises:
        ValueError: the name is not known as a unit of that quantity.
    """
    plain = text.strip().strip("[]()")
    try:
        value = float(plain)
    except ValueError:
        value = _named(plain, quantity)
    if not 0 < value < float("inf"):
        raise ValueError(f"a unit of {quantity} must be a positive number of SI units or a name, not {text!r}")
    return value


def _named(plain: str, quantity: str) -> float:
    tables = {"length": LENGTH, "time": TIME, **OTHER}
    if quantity in tables:
        found = tables[quantity].get(plain) or tables[quantity].get(plain.lower())
        if found is None:
            raise ValueError(f"{plain!r} is no unit of {quantity} known here; give a number of SI units or a name")
        return found
    for mark in ("**", "^", "{", "}"):
        plain = plain.replace(mark, "")
    for sign in (" per ", "/"):
        if sign in plain:
            length, _, time = plain.partition(sign)
            return _named(length.strip(), "length") / _named(time.strip(), "time")
    words = plain.replace("*", " ").replace("·", " ").replace(".", " ").split()
    if len(words) == 2 and words[1].endswith("-1"):
        return _named(words[0], "length") / _named(words[1].removesuffix("-1"), "time")
    raise ValueError(f"{plain!r} is no unit of velocity known here; write it as cm/s or give a number of m/s")
