"""Curves over time for a page: quantities of a flow with their bands, and measures of the methods.

Quantities come as `torchsph quantify` and `assimilate` write them: for each source (`analysis`, `truth`) and each name
the values over time, and of the members for each name a mapping with `mean`, `low` and `high`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchsph.evaluation.metrics import UNITS as MEASURES
from torchsph.evaluation.scores import Scores

NAMES = {
    "volume": "Volume",
    "kinetic_energy": "Kinetic energy",
    "kinetic_energy_density": "Kinetic energy per volume",
    "energy_loss": "Energy loss",
    "vorticity_rms": "Vorticity, RMS",
    "helicity": "Helicity",
    "force_axial": "Force along the axis",
    "force_across": "Force across the axis",
    "pressure_difference": "Pressure difference, base less apex",
    "flow_inlet": "Flow through the inlet",
    "flow_outlet": "Flow through the outlet",
    "nrmse": "Error of the velocity",
    "residual_rms": "Distance to the measurement",
    "divergence_rms": "Divergence, RMS",
}
FIRST = ("kinetic_energy", "pressure_difference", "flow_inlet", "flow_outlet", "energy_loss", "vorticity_rms", "volume")
MEASURES_SHOWN = ("nrmse", "residual_rms")
PEOPLES = {"m3": (1e6, "ml"), "m3/s": (1e6, "ml/s")}
PREFIXED = ("J", "W", "N", "J/m3")
PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"))


@dataclass(frozen=True)
class Line:
    """Values over time; `low` and `high` are a band around them, or None."""

    label: str
    time: np.ndarray
    values: np.ndarray
    low: np.ndarray | None = None
    high: np.ndarray | None = None


@dataclass(frozen=True)
class Curve:
    """One quantity over time, of one source or several."""

    name: str
    unit: str
    lines: tuple[Line, ...]

    def plain(self) -> dict[str, Any]:
        """For JSON, in a unit whose numbers people can read; what is no number becomes None."""
        factor, unit = _scale(self.unit, [line.values for line in self.lines])

        def numbers(values: np.ndarray | None) -> list[float | None] | None:
            if values is None:
                return None
            return [float(f"{factor * value:.5g}") if np.isfinite(value) else None for value in values]

        lines = [
            {
                "label": line.label,
                "time": [float(f"{t:.9g}") for t in line.time],
                "values": numbers(line.values),
                "low": numbers(line.low),
                "high": numbers(line.high),
            }
            for line in self.lines
        ]
        return {"name": NAMES.get(self.name, self.name.replace("_", " ")), "unit": unit, "lines": lines}


def _scale(unit: str, values: Sequence[np.ndarray]) -> tuple[float, str]:
    if unit in PEOPLES:
        return PEOPLES[unit]
    known = [np.abs(each[np.isfinite(each)]).max(initial=0.0) for each in values]
    largest = float(max(known, default=0.0))
    if unit not in PREFIXED or largest == 0:
        return 1.0, "" if unit == "1" else unit
    factor, prefix = next((pair for pair in PREFIXES if largest * pair[0] >= 1), PREFIXES[-1])
    return factor, prefix + unit


def curves_of(quantities: Mapping[str, Any]) -> list[Curve]:
    """The curves of a document of quantities, the ones that are asked for most first.

    Args:
        quantities: `quantities.json`, read or as it is about to be written. What is not understood of it is left out.
    """
    units, sources = _mapping(quantities.get("units")), dict(_mapping(quantities.get("curves")))
    members = _mapping(_mapping(quantities.get("members")).get("curves"))
    if members:
        truth = {"truth": sources.pop("truth")} if "truth" in sources else {}
        sources |= {"members": members} | truth
    time = _array(quantities.get("time", quantities.get("times")))
    found: dict[str, list[Line]] = {}
    for source, curves in sources.items():
        for name, values in _mapping(curves).items():
            line = _line(source, values, time)
            if line is not None:
                found.setdefault(name, []).append(line)
    order = [*(name for name in FIRST if name in found), *(name for name in found if name not in FIRST)]
    return [Curve(name, str(units.get(name, "")), tuple(found[name])) for name in order]


def _line(source: str, values: Any, time: np.ndarray | None) -> Line | None:
    given = _mapping(values)
    own = _array(given.get("time", given.get("times"))) if given else None
    time = time if own is None else own
    middle = _array(given.get("mean", given.get("value")) if given else values)
    if time is None or middle is None or time.shape != middle.shape:
        return None
    low, high = (_array(given.get(name)) for name in ("low", "high"))
    if low is None or high is None or not low.shape == high.shape == middle.shape:
        low = high = None
    return Line(source, time, middle, low, high)


def beat_table(quantities: Mapping[str, Any]) -> list[list[str]]:
    """Heading and rows of the numbers of the beat: name, unit, a column for each source, and the members' band.

    Nothing where the document has none.
    """
    sources, units = _mapping(quantities.get("beat")), _mapping(quantities.get("units"))
    bands = _mapping(_mapping(quantities.get("members")).get("beat"))
    names = list(dict.fromkeys(name for numbers in sources.values() for name in _mapping(numbers)))
    if not names:
        return []
    rows = [["number", "unit", *sources, *(["members", "nine of ten within"] if bands else [])]]
    for name in names:
        values = [_number(_mapping(numbers).get(name)) for numbers in sources.values()]
        band = [_number(_mapping(bands.get(name)).get(part)) for part in ("mean", "low", "high")]
        known = [np.array([value]) for value in [*values, *band] if np.isfinite(value)]
        if not known:
            continue
        factor, unit = (1e3, "ms") if units.get(name) == "s" else _scale(str(units.get(name, "")), known)
        told = [_told(factor * value) for value in values]
        if bands:
            told += [_told(factor * band[0])]
            told += [" to ".join(_told(factor * end) for end in band[1:]) if np.isfinite(band[1:]).all() else "-"]
        rows.append([name.replace("_", " "), unit, *told])
    return rows


def _number(value: Any) -> float:
    """A number, from whatever stands for one in a document; nan from anything else."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _told(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "-"


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _array(value: Any) -> np.ndarray | None:
    """A row of numbers, None among them counting as no number; None for anything else."""
    if value is None or isinstance(value, str | Mapping):
        return None
    try:
        row = np.array([np.nan if one is None else one for one in value], np.float64)
    except (TypeError, ValueError):
        return None
    return row if row.ndim == 1 and len(row) else None


def measure_curves(scores: Mapping[str, Scores], time: np.ndarray) -> list[Curve]:
    """Error and distance to the measurement over time, of every method that has them."""
    found = []
    for measure in MEASURES_SHOWN:
        lines = [
            Line(method, time, np.array(score[measure].per_frame, np.float64))
            for method, score in scores.items()
            if measure in score and not (measure == "residual_rms" and method == "raw")
        ]
        lines = [line for line in lines if line.values.shape == time.shape and np.isfinite(line.values).any()]
        if lines:
            found.append(Curve(measure, MEASURES[measure], tuple(lines)))
    return found
