"""Members of a ventricle against real time, and the parts of an ensemble's cycle."""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import torch

import geometry
from torchsph import Scene, Simulator, assimilate, preset
from torchsph.assimilation import LETKF
from torchsph.data import sample_measurement
from torchsph.methods.ensemble.innovation_spline import InnovationSpline
from torchsph.methods.measurement.observation_operator import Measurement
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulation import Simulation

from .bench import Bench

SPACINGS = (1e-3, 0.7e-3)
MEMBERS = (1, 4, 16, 32, 64)
# what is timed of a cycle: where it stands, and what it is called
STAGES = (
    (Simulation, "impose", "impose"),
    (Simulation, "project", "project"),
    (Simulation, "advance", "advance"),
    (Simulation, "fetch", "fetch"),
    (Measurement, "predict", "observation operator"),
    (LETKF, "analyse", "filter"),
    (InnovationSpline, "of", "spline of innovations"),
)


def ventricle(bench: Bench) -> tuple[geometry.Recording, str]:
    """The phantom where it is, else the packaged sample; and which of them."""
    if bench.recording.is_file() and not bench.fast:
        return geometry.read_recording(bench.recording), bench.recording.stem
    return geometry.read_recording(sample_measurement()), "sample"


def members(bench: Bench) -> None:
    """Forecasts from one frame to the next: imposed, projected, advanced, fetched; default preset."""
    recording, name = ventricle(bench)
    first = int(0.2 * recording.frames)  # in ejection
    recording = recording.select(slice(first, first + 3))
    for spacing in (4e-3,) if bench.fast else SPACINGS:
        with bench.attempt(recording=name, spacing=spacing):
            model = Simulator(Scene.from_recording(recording, spacing), preset("default"), device=bench.device)
            began = time.perf_counter()
            model.domain.prepare_until(float(recording.time[0]), float(recording.time[2]))
            bench.add(recording=name, spacing_mm=1e3 * spacing, tables_s=time.perf_counter() - began)
            for count in (1, 2) if bench.fast else MEMBERS:
                with bench.attempt(recording=name, spacing=spacing, members=count):
                    _forecasts(bench, recording, name, model, count)


def _forecasts(bench: Bench, recording: geometry.Recording, name: str, model: Simulator, count: int) -> None:
    masks = [torch.from_numpy(np.array(mask, bool)).to(bench.device) for mask in recording.mask]
    field = torch.from_numpy(np.nan_to_num(recording.velocity)).to(bench.device)
    begin, middle, end = (float(t) for t in recording.time)
    start = field[0].expand(count, *field.shape[1:])
    going = GridForecast(model, recording.grid, start, masks[0], begin, Transfer())
    going.at(middle, masks[1])  # compiles, and fills the memory's pool
    bench.wait()
    began, before = time.perf_counter(), int(going.run.record.steps.sum())
    going = GridForecast(model, recording.grid, field[1].expand_as(start), masks[1], middle, Transfer())
    going.at(end, masks[2])[0].cpu()
    taken, record = time.perf_counter() - began, going.run.record
    bench.add(
        recording=name,
        spacing_mm=1e3 * model.scene.spacing,
        members=count,
        particles=going.run.particles.count,
        backend=going.run.backend.name,
        seconds=taken,
        of_real_time=taken / (end - middle),
        steps=int(record.steps.max()),
        solver_iterations=float(record.pressure_iterations.double().mean() / record.steps.double().mean()),
        failed=int(record.failed.sum()),
        memory_gb=bench.memory,
        steps_before=before,
    )


def cycle(bench: Bench) -> None:
    """Seconds a cycle of each part of the ensemble, of which every other one waits for the device."""
    recording, name = ventricle(bench)
    if name != "sample":  # a truth has no errors to learn from
        recording, name = geometry.read_recording(sample_measurement()), "sample"
    frames = 3 if bench.fast else 6
    recording = recording.select(slice(8, 8 + frames))
    spacing, count = (4e-3, 3) if bench.fast else (1e-3, 16)
    fine = Simulator(Scene.from_recording(recording, spacing), preset("default"), device=bench.device)
    scale = 1.0 if bench.fast else 2.0  # still larger particles do not fit into the sample
    coarse = Simulator(Scene.from_recording(recording, scale * spacing), preset("default"), device=bench.device)
    for label in ("first, tables and kernels are made", "second") if not bench.fast else ("only",):
        with bench.attempt(run=label), timed(bench) as spent:
            began = time.perf_counter()
            assimilate(recording, fine, coarse=coarse, members=count, seed=0)
            whole = time.perf_counter() - began
            parts = {f"{stage} (s)": spent[stage] / (frames - 1) for _, _, stage in STAGES}
            other = (whole - sum(spent.values())) / (frames - 1)
            bench.add(
                run=label,
                recording=name,
                spacing_mm=1e3 * spacing,
                members=count,
                cycle_s=whole / (frames - 1),
                real_time_s=float(np.diff(recording.time).mean()),
                **parts,
                **{"all else (s)": other},
                memory_gb=bench.memory,
            )


@contextmanager
def timed(bench: Bench) -> Iterator[Counter]:
    """Seconds by stage; a stage inside another one counts for the inner one alone."""
    spent: Counter = Counter()
    running: list[float] = []
    originals = [(owner, method, getattr(owner, method)) for owner, method, _ in STAGES]

    def watched(call: Callable, stage: str) -> Callable:
        @functools.wraps(call)
        def clocked(*args, **kwargs):
            bench.wait()
            began = time.perf_counter()
            running.append(0.0)
            try:
                return call(*args, **kwargs)
            finally:
                bench.wait()
                taken = time.perf_counter() - began
                spent[stage] += taken - running.pop()
                if running:
                    running[-1] += taken

        return clocked

    for owner, method, stage in STAGES:
        setattr(owner, method, watched(getattr(owner, method), stage))
    try:
        yield spent
    finally:
        for owner, method, original in originals:
            setattr(owner, method, original)
