"""What drives the flow through the valves over the beat, with the cavity's volume (Grønli 2017, fig. 4.11).

The thesis's pulsating sources as the pressure that they make at the middle of their orifice; and, for both presets, the
flow through the valves of a run without measurements beside the flow that the moving walls ask for.
"""

from __future__ import annotations

import math
import warnings
from functools import partial

import numpy as np
import torch
from matplotlib.figure import Figure

import torchsph as ts
from torchsph.simulator.valves.pressure_sources import PressureSources

from ..material import Material
from ..record import Claim, Result
from ..style import COLOUR, axes


def make(material: Material) -> Result:
    """Source pressure, Pa, and flow through the valves, m^3/s, from the first frame on."""
    truth = material.truth
    scene = material.scene(2e-3)
    times = truth.time[:5] if material.fast else truth.time
    models = {name: ts.Simulator(scene, ts.preset(name)) for name in ("thesis", "default")}
    walls = models["default"].scene.walls
    assert walls is not None
    asked = np.array([walls.volume_rate(float(t)) for t in 0.5 * (times[1:] + times[:-1])])
    flows = {
        name: np.array(material.part(name, partial(_flow, model, material, times))) for name, model in models.items()
    }
    steps = np.diff(times)
    total = np.cumsum(asked * steps)
    numbers = {
        "time": [float(t) for t in times],
        "volume": [float(walls.volume(float(t))) for t in times],
        "asked_flow": asked.tolist(),
        "flow": {name: flow.tolist() for name, flow in flows.items()},
        "source_pressure": _source_pressure(models["thesis"], times),
        "volume_error": {
            name: float(np.sqrt(((np.cumsum(flow * steps) - total) ** 2).mean() / (total**2).mean()))
            for name, flow in flows.items()
        },
    }
    lost = numbers["volume_error"]
    strongest = [max(map(abs, row)) for row in numbers["source_pressure"].values()]
    claims = [
        Claim(
            "gauge pressures at the valves pulsate as these open and close",
            max(strongest) > 0,
            "largest source pressure " + ", ".join(f"{value:.0f} Pa" for value in strongest),
        ),
        Claim(
            "particles do not pass the valves in sufficient number (no reseeding, vacuum near the inlet)",
            numbers["volume_error"]["thesis"] > 0.5,
            f"the volume that has passed the valves differs from that of the walls by {lost['thesis']:.2f} of its RMS "
            f"with the thesis's sources, by {lost['default']:.2f} with reservoirs",
        ),
    ]

    def draw() -> Figure:
        return _draw(numbers)

    return Result(numbers, claims, material.settings(spacing_m=scene.spacing), draw)


def _flow(model: ts.Simulator, material: Material, times: np.ndarray) -> list[float]:
    """Net flow into the cavity between times, m^3/s, of a run that starts with the true field."""
    truth = material.truth
    first = int(np.abs(truth.time - times[0]).argmin())
    run = model.start(float(times[0]), seed=material.seed)
    mask = torch.from_numpy(np.array(truth.mask[first], bool))
    run.impose(truth.grid, torch.from_numpy(np.nan_to_num(truth.velocity[first])), mask)
    if run.can_project:
        run.project(2)
    passed = [0.0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of volume that is lost: what is measured here
        for time in times[1:]:
            try:
                run.advance(float(time))
            except ts.NumericalFailure:  # volume more than 20 % off: nothing passes from then on
                passed += [passed[-1]] * (len(times) - len(passed))
                break
            passed.append(float((run.record.inflow - run.record.outflow).sum()))
    return (np.diff(passed) / np.diff(times)).tolist()


def _source_pressure(model: ts.Simulator, times: np.ndarray) -> dict[str, list[float]]:
    """rho Q / core of each valve while it is open (Grønli 2017, eq. 3.3, softened), Pa."""
    sources, scene = model.domain.valves, model.scene
    assert isinstance(sources, PressureSources)
    found = {}
    for valve in scene.valves:
        core = sources._core[valve.region] * model.domain.units.length
        rows = [sources.strength(float(t)) / (2 * math.pi * core) if valve.is_open(float(t)) else 0.0 for t in times]
        found[f"region {valve.region}"] = [scene.fluid.density * value for value in rows]
    return found


def _draw(numbers: dict) -> Figure:
    figure, (first, second) = (lambda pair: (pair[0], pair[1][0]))(axes(1, 2, 10, 3.4))
    ms = 1e3 * np.array(numbers["time"])
    for name, row in numbers["source_pressure"].items():
        first.plot(ms, row, label=f"source, {name}")
    first.set(xlabel="ms", ylabel="Pa", title="the thesis's sources")
    first.legend(fontsize=8, loc="lower left")
    volume = first.twinx()
    volume.plot(ms, 1e6 * np.array(numbers["volume"]), color="tab:green")
    volume.set_ylabel("volume, ml", color="tab:green")
    middle = 0.5 * (ms[1:] + ms[:-1])
    second.plot(middle, 1e6 * np.array(numbers["asked_flow"]), color="k", linewidth=2, label="dV/dt of the walls")
    for name, row in numbers["flow"].items():
        second.plot(middle, 1e6 * np.array(row), color=COLOUR[name], label=name)
    second.set(xlabel="ms", ylabel="ml/s into the ventricle", title="flow through the valves, free runs")
    second.legend(fontsize=8)
    return figure
