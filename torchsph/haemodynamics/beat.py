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

__all__ = ["BEAT_UNITS", "beat_numbers"]

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


def beat_numbers(time: ArrayLike, curves: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Every number of `BEAT_UNITS`, each `(*batch)`.

    Args:
        time: `(T,)`, s.
        curves: by the names of `quantities.UNITS`, `(*batch, T)`.
    """
    times = np.asarray(time, np.float64)
    arrays = {name: np.asarray(curve, np.float64) for name, curve in curves.items()}
    volume, energy, drop = (arrays[name] for name in ("volume", "kinetic_energy", "pressure_difference"))
    largest = volume.max(-1)
    span = float(times[-1] - times[0])
    highest, lowest = _extreme(times, drop), _extreme(times, -drop)
    waves = np.apply_along_axis(lambda curve: _waves(times, curve), -1, arrays["flow_inlet"])
    return {
        "stroke_volume_wall": largest - volume.min(-1),
        "ejection_fraction": (largest - volume.min(-1)) / largest,
        "stroke_volume": stroke_volume(times, arrays["flow_outlet"]),
        "filling_volume": stroke_volume(times, arrays["flow_inlet"]),
        "regurgitant_fraction_inlet": regurgitant_fraction(times, arrays["flow_inlet"]),
        "regurgitant_fraction_outlet": regurgitant_fraction(times, arrays["flow_outlet"]),
        "e_wave": waves[..., 0],
        "a_wave": waves[..., 1],
        "e_over_a": waves[..., 4],
        "e_time": waves[..., 2],
        "a_time": waves[..., 3],
        "energy_lost": np.trapezoid(arrays["energy_loss"], times, axis=-1),
        "kinetic_energy_mean": np.trapezoid(energy, times, axis=-1) / span,
        "kinetic_energy_peak": energy.max(-1),
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
