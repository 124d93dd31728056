"""What workers of tests do: they import it by its name, as processes of their own."""

from __future__ import annotations

import os
import signal
import time
import warnings
from functools import partial
from typing import Any

import geometry
from torchsph.methods.runtime import parallel

# what simulates is imported by the one that does: the others start in half the time


def task(number: int) -> tuple[int, int]:
    """The number and the process that had it."""
    if parallel.is_worker():
        warnings.warn(f"task {number}", stacklevel=1)
    time.sleep(0.2)
    return number, parallel.rank()


def methods(recording: geometry.Recording, measured: geometry.Recording) -> dict[str, Any]:
    """Forecasts of a recording, splines and ensemble of a measurement."""
    from torchsph import EnsembleOptions, PreparedMeasurement, Scene, Simulator, assimilate, preset, skill

    def model(scene: geometry.Recording) -> Simulator:
        return Simulator(Scene.from_recording(scene, 4e-3), preset("default"))

    prepared = PreparedMeasurement(measured)
    run = assimilate(prepared, model(measured), members=2, options=EnsembleOptions(batch=1), seed=1)
    found = skill(recording, model(recording), [0.005, 0.01], save=True)
    return {
        "splines": prepared.smoothed.velocity,
        "analysis": run.recording.velocity,
        "sigma": run.recording.sigma,
        "leads": found.leads,
        "forecast": found.recordings[0.01].velocity,
        "totals": found.info,
    }


def exchanges() -> dict[str, Any]:
    """What processes tell one another, and how tasks are parted once all have come."""
    return {
        "lead": parallel.from_lead(parallel.rank()),
        "last": parallel.from_last(parallel.rank()),
        "anywhere": (parallel.anywhere(False), parallel.anywhere(parallel.is_last())),
        "tasks": parallel.shared([partial(task, k) for k in range(10)]),
    }


def failing(how: str) -> None:
    """A worker that ends in some way while the others wait for it."""
    if parallel.is_worker():
        if how == "raises":
            raise ValueError("nothing is left")
        os.kill(os.getpid(), getattr(signal, how))
    parallel.anywhere(False)


def waiting(path: str) -> None:
    """A worker that works for longer than anyone waits; the file holds the number of its process."""
    if parallel.is_worker():
        with open(path, "w", encoding="ascii") as file:
            file.write(str(os.getpid()))
        time.sleep(600)
    parallel.anywhere(False)
