"""What must be the same for a run to go on where another one stopped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

import geometry
from torchsph.assimilation import Filter
from torchsph.simulator.scene import Valve
from torchsph.simulator.simulator import Simulator

from ..measurement.prepared import PreparedMeasurement
from ..runtime.checkpoint import run_key
from .options import EnsembleOptions


def ensemble_key(
    prepared: Sequence[PreparedMeasurement],
    model: Simulator,
    coarse: Simulator,
    filter_: Filter | None,
    options: EnsembleOptions,
    *,
    members: int,
    seed: int,
    truth: geometry.Recording | None = None,
) -> str:
    """The key of a run's checkpoints: all that enters it, part by part.

    The number of processes and threads does not enter, nor how few members may be alive (that ends a run, and changes
    no result).
    """
    return run_key(
        {
            "measurement": [*_recording(prepared[0].recording), prepared[0].splines.smoother],
            "further measurements": [part for one in prepared[1:] for part in _recording(one.recording)],
            "truth": [] if truth is None else _recording(truth),
            "simulator": [*_simulator(model), *_simulator(coarse)],
            "filter": [filter_],
            "options": [replace(options, minimum_members=None)],
            "members": [members],
            "seed": [seed],
        }
    )


def _recording(recording: geometry.Recording) -> list[object]:
    named = [part for name, array in recording.arrays().items() for part in (name, array)]
    return [recording.grid, recording.rho, recording.mu, recording.period, *named]


def _simulator(one: Simulator) -> list[object]:
    scene = one.scene
    walls = (
        () if scene.walls is None else tuple(_plain(getattr(scene.walls, part.name)) for part in fields(scene.walls))
    )
    flow = (scene.spacing, scene.fluid, _plain(scene.gravity), scene.period, scene.reference_speed)
    return [one.scheme, one.dtype, one.seeding, *flow, *(_valve(valve) for valve in scene.valves), *walls]


def _valve(valve: Valve) -> tuple[object, ...]:
    return tuple(_plain(getattr(valve, part.name)) for part in fields(valve))


def _plain(value: object) -> object:
    """A function by its name, which outlasts the process, unlike its address; anything else as it is."""
    if isinstance(value, np.ndarray) or not callable(value):
        return value
    return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value).__qualname__)}"
