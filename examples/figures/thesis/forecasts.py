"""Forecasts from true frames to the next one at several frame rates, without and with valves (figs. 4.12, 4.13)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import geometry
import torchsph as ts

from ..material import Material, per_frame_error
from ..record import Claim, Result
from ..style import axes

RATES = (200, 100, 50, 25)  # Hz
CASES = {"without valves": False, "with valves": True}


def make(material: Material) -> Result:
    """NRMSE of each preset over frame rate, and error over time; persistence beside them."""
    truth = material.truth
    rates = RATES[1:3] if material.fast else RATES
    spacing = (2.5 if material.fast else 1.8) * 1e-3
    starts = {"every": truth.frames} if material.fast else {"every": 6}
    numbers: dict[str, dict] = {"nrmse": {}, "over_time": {}, "persistence": {}, "failed_starts": {}}
    for preset in ("thesis", "default"):
        for case, valves in CASES.items():

            def forecast(preset: str = preset, valves: bool = valves) -> dict[str, Any]:
                return _case(material, preset, valves, spacing, rates, starts)

            name = f"{preset}, {case}"
            found = material.part(name, forecast)
            numbers["persistence"] = found.pop("persistence")
            for key, value in found.items():
                numbers[key][name] = value
    numbers["rates_hz"] = list(rates)
    settings = material.settings(spacing_m=spacing, **starts)
    return Result(numbers, _claims(numbers), settings, lambda: _draw(numbers))


def _case(
    material: Material, preset: str, valves: bool, spacing: float, rates: Sequence[int], starts: dict[str, int]
) -> dict[str, Any]:
    """Errors of one preset with its valves, or with none."""
    truth, scene = material.truth, material.scene(spacing)
    scheme = ts.preset(preset) if valves else ts.preset(preset, valve=None)
    model = ts.Simulator(scene if valves else replace(scene, valves=()), scheme)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of volume that shut valves cannot let through
        found = ts.skill(truth, model, [1 / rate for rate in rates], save=True, seed=material.seed, **starts)
    # starts that failed, because volume was lost, count nowhere
    return {
        "nrmse": [row["nrmse"]["model"] for row in found.leads],
        "persistence": [row["nrmse"]["persistence"] for row in found.leads],
        "failed_starts": len(found.failures),
        "over_time": {f"{rate} Hz": _over_time(found.recordings[1 / rate], truth) for rate in rates},
    }


def _over_time(forecast: geometry.Recording, truth: geometry.Recording) -> dict[str, list[float]]:
    frames = [int(np.abs(truth.time - time).argmin()) for time in forecast.time]
    part = truth.select(np.array(frames))
    wrong, _ = per_frame_error(forecast.velocity, np.nan_to_num(part.velocity), np.asarray(part.mask, bool))
    return {"time": forecast.time.tolist(), "rms_error": wrong.tolist()}


def _claims(numbers: dict) -> list[Claim]:
    nrmse, at = numbers["nrmse"], numbers["rates_hz"].index(50)
    values = {name: row[at] for name, row in nrmse.items()}
    still = numbers["persistence"][at]
    return [
        Claim(
            "without valves forecasts lose accuracy in ejection and filling; with them they gain",
            values["thesis, with valves"] < values["thesis, without valves"],
            f"thesis preset at 50 Hz: {values['thesis, without valves']:.3f} without, "
            f"{values['thesis, with valves']:.3f} with valves; default: {values['default, without valves']:.3f} and "
            f"{values['default, with valves']:.3f}; persistence {still:.3f}",
        ),
        Claim(
            "with valves the model emulates the phantom with reasonable accuracy over medium intervals",
            values["thesis, with valves"] < still,
            f"at 50 Hz the thesis preset's error is {values['thesis, with valves'] / still:.2f} of persistence's, "
            f"the default's {values['default, with valves'] / still:.2f}",
        ),
        Claim(
            "the assumption of static valves turns more severe as the frame rate goes down",
            math.isfinite(values["default, without valves"])
            and nrmse["default, without valves"][-1] - nrmse["default, with valves"][-1]
            > nrmse["default, without valves"][0] - nrmse["default, with valves"][0],
            "default preset, error without less error with valves: "
            + ", ".join(
                f"{a - b:.3f}"
                for a, b in zip(nrmse["default, without valves"], nrmse["default, with valves"], strict=True)
            )
            + " at "
            + ", ".join(f"{rate} Hz" for rate in numbers["rates_hz"]),
        ),
    ]


def _draw(numbers: dict) -> Figure:
    figure, panels = axes(2, 3, 11, 3.0)
    for row, preset in enumerate(("thesis", "default")):
        for column, case in enumerate(CASES):
            panel = panels[row, column]
            for name, found in numbers["over_time"][f"{preset}, {case}"].items():
                panel.plot(1e3 * np.array(found["time"]), found["rms_error"], marker=".", label=name)
            panel.set(title=f"{preset}, {case}", ylabel="RMS error, m/s", xlabel="ms", ylim=(0, None))
            panel.legend(fontsize=7)
        last = panels[row, 2]
        lead = 1e3 / np.array(numbers["rates_hz"])
        for case in CASES:
            last.plot(lead, numbers["nrmse"][f"{preset}, {case}"], "o-", label=case)
        last.plot(lead, numbers["persistence"], "k:", label="nothing changes")
        last.set(xlabel="lead, ms", ylabel="error / RMS speed", ylim=(0, 1.6), title=preset)
        last.legend(fontsize=7)
    return figure
