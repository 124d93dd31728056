"""Numbers of a beat, from the curves of `flow_quantities`.

| number | of the curves | unit |
|---|---|---|
| `stroke_volume_wall` | largest less smallest volume that the wall encloses | m3 |
| `ejection_fraction` | that over the largest volume | 1 |
| `stroke_volume` | flow through the outlet, integrated | m3 |
| `filling_volume` | flow through the inlet, integrated | m3 |
| `regurgitant_fraction_inlet`, `..._outlet` | backward over forward volume | 1 |
| `e_wave`, `a_wave`, `e_over_a`, `e_time`, `a_time` | first and last peak of the inflow | m3/s, 1, s |
| `energy_lost` | energy loss, integrated | J |
| `kinetic_energy_mean`, `kinetic_energy_peak` | over time | J |
| `pressure_difference_highest`, `..._lowest` and their times | base less apex | Pa, s |

A number that the frames do not hold (no inflow, no second wave, an extreme at the first or last frame for its time) is
nan. A recording of part of a beat gives the numbers of that part.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .flow_rate import FillingPeaks, e_and_a, regurgitant_fraction, stroke_volume

__all__ = ["BEAT_UNITS", "CUT_BEAT_UNITS", "PLANE_BEAT_UNITS", "beat_numbers", "plane_beat_numbers"]

Array = NDArray[np.float64]

BEAT_UNITS = {
    "stroke_volume_wall": "m3",
    "ejection_fraction": "1",
    "stroke_volume": "m3",
    "filling_volume": "m3",
    "regurgitant_fraction_inlet": "1",
    "regurgitant_fraction_outlet": "1",
    "e_wave": "m3/s",
    "a_wave": "m3/s",
    "e_over_a": "1",
    "e_time": "s",
    "a_time": "s",
    "energy_lost": "J",
    "kinetic_energy_mean": "J",
    "kinetic_energy_peak": "J",
    "pressure_difference_highest": "Pa",
    "pressure_difference_highest_time": "s",
    "pressure_difference_lowest": "Pa",
    "pressure_difference_lowest_time": "s",
}

_DROP_UNITS = {name: unit for name, unit in BEAT_UNITS.items() if name.startswith("pressure_difference")}

CUT_BEAT_UNITS = {
    "area_change": "m2",
    "fractional_area_change": "1",
    "outflow": "m2",
    "inflow": "m2",
    "e_wave": "m2/s",
    "a_wave": "m2/s",
    "e_over_a": "1",
    "e_time": "s",
    "a_time": "s",
    "energy_lost": "J/m",
    "kinetic_energy_mean": "J/m",
    "kinetic_energy_peak": "J/m",
    "vortex_positive_peak": "m2/s",
    "vortex_positive_peak_time": "s",
    "vortex_negative_peak": "m2/s",
    "vortex_negative_peak_time": "s",
}

PLANE_BEAT_UNITS = CUT_BEAT_UNITS | _DROP_UNITS


def beat_numbers(time: ArrayLike, curves: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Every number of `BEAT_UNITS`, each `(*batch)`.

    Args:
        time: `(T,)`, s.
        curves: by the names of `quantities.UNITS`, `(*batch, T)`.
    """
    times = np.asarray(time, np.float64)
    arrays = {name: np.asarray(curve, np.float64) for name, curve in curves.items()}
    volume = arrays["volume"]
    largest = volume.max(-1)
    return {
        "stroke_volume_wall": largest - volume.min(-1),
        "ejection_fraction": (largest - volume.min(-1)) / largest,
        "stroke_volume": stroke_volume(times, arrays["flow_outlet"]),
        "filling_volume": stroke_volume(times, arrays["flow_inlet"]),
        "regurgitant_fraction_inlet": regurgitant_fraction(times, arrays["flow_inlet"]),
        "regurgitant_fraction_outlet": regurgitant_fraction(times, arrays["flow_outlet"]),
        **_filling(times, arrays["flow_inlet"]),
        **_energies(times, arrays),
        **_drops(times, arrays["pressure_difference"]),
    }


def plane_beat_numbers(time: ArrayLike, curves: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Every number of `PLANE_BEAT_UNITS`, or of `CUT_BEAT_UNITS` where the curves have no pressure, each `(*batch)`.

    Args:
        time: `(T,)`, s.
        curves: by the names of `plane_quantities.PLANE_UNITS`, `(*batch, T)`.
    """
    times = np.asarray(time, np.float64)
    arrays = {name: np.asarray(curve, np.float64) for name, curve in curves.items()}
    area = arrays["area"]
    largest = area.max(-1)
    turning, back = _extreme(times, arrays["vortex_positive"]), _extreme(times, -arrays["vortex_negative"])
    return {
        "area_change": largest - area.min(-1),
        "fractional_area_change": (largest - area.min(-1)) / largest,
        "outflow": stroke_volume(times, arrays["flow_outlet"]),
        "inflow": stroke_volume(times, arrays["flow_inlet"]),
        **_filling(times, arrays["flow_inlet"]),
        **_energies(times, arrays),
        "vortex_positive_peak": turning[..., 1],
        "vortex_positive_peak_time": turning[..., 0],
        "vortex_negative_peak": -back[..., 1],
        "vortex_negative_peak_time": back[..., 0],
        **(_drops(times, arrays["pressure_difference"]) if "pressure_difference" in arrays else {}),
    }


def _filling(times: Array, inflow: Array) -> dict[str, Array]:
    """First and last wave of the inflow `(*batch, T)`."""
    waves = np.apply_along_axis(lambda curve: _waves(times, curve), -1, inflow)
    names = {"e_wave": 0, "a_wave": 1, "e_over_a": 4, "e_time": 2, "a_time": 3}
    return {name: waves[..., place] for name, place in names.items()}


def _energies(times: Array, arrays: Mapping[str, Array]) -> dict[str, Array]:
    energy, span = arrays["kinetic_energy"], float(times[-1] - times[0])
    return {
        "energy_lost": np.trapezoid(arrays["energy_loss"], times, axis=-1),
        "kinetic_energy_mean": np.trapezoid(energy, times, axis=-1) / span,
        "kinetic_energy_peak": energy.max(-1),
    }


def _drops(times: Array, drop: Array) -> dict[str, Array]:
    """Highest and lowest pressure difference of a curve `(*batch, T)`, and when."""
    highest, lowest = _extreme(times, drop), _extreme(times, -drop)
    return {
        "pressure_difference_highest": highest[..., 1],
        "pressure_difference_highest_time": highest[..., 0],
        "pressure_difference_lowest": -lowest[..., 1],
        "pressure_difference_lowest_time": lowest[..., 0],
    }


def _waves(time: Array, inflow: Array) -> Array:
    if not inflow.max() > 0:
        return np.full(len(FillingPeaks._fields), np.nan)
    return np.array(e_and_a(time, inflow))


def _extreme(time: Array, curve: Array) -> Array:
    """Time and height of the highest value `(*batch, 2)`: the vertex of a parabola; at an end its time is nan."""

    def find(values: Array) -> Array:
        n = int(values.argmax())
        if not 0 < n < len(values) - 1:
            return np.array([np.nan, values[n]])
        x = time[n - 1 : n + 2] - time[n]
        a, b, c = np.polyfit(x, values[n - 1 : n + 2], 2)
        place = -b / (2 * a) if a < 0 else 0.0
        return np.array([time[n] + place, c + b * place + a * place**2])

    return np.apply_along_axis(find, -1, curve)
