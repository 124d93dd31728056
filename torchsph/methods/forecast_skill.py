"""How good the simulator's forecasts are against a recording's later frames, by lead time."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

import geometry
from geometry.arguments import between, checked
from torchsph.evaluation.frames import frame_at
from torchsph.simulator.failures import NumericalFailure
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.simulator import Simulator
from torchsph.simulator.transfer.checks import check_grid

from .runtime.parallel import advanced, shared


@dataclass(frozen=True)
class ForecastSkill:
    """Errors of forecasts against lead time.

    Attributes:
        leads: one entry per lead: ``{"lead": s, "starts": n, "nrmse": {"model": x, "persistence": y}}``.
        seconds: ``{"setup": s, "forecast": s}``, of all starts, whichever process ran them. config: what was run.
        recordings: the forecasts of each lead, valid at their time; empty unless they were asked for.
        info: accounts of the runs.
        failures: one entry per start that failed, in none of the errors: ``{"frame": n, "time": s, "reason": text}``.
    """

    leads: list[dict[str, Any]]
    seconds: dict[str, float]
    config: dict[str, Any]
    recordings: dict[float, geometry.Recording] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    failures: list[dict[str, Any]] = field(default_factory=list)


class _Squares(NamedTuple):
    """Sums of squares over the nodes of one start and lead: model error, persistence error, reference."""

    model: float
    persistence: float
    reference: float


@dataclass(frozen=True)
class _Start:
    """What the forecast from one frame gives.

    Attributes:
        frame: from which it starts.
        squares: of each lead.
        fields: of each lead, where they are kept: the frame that it reaches, the forecast there (D, *shape), m/s, and
            the nodes that it lacks.
        seconds: it took.
        totals: accounts of the run.
        failure: why there is none of all this.
    """

    frame: int
    squares: dict[float, _Squares] = field(default_factory=dict)
    fields: dict[float, tuple[int, np.ndarray, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: {"setup": 0.0, "forecast": 0.0})
    totals: dict[str, float] = field(default_factory=dict)
    failure: str | None = None


@checked(every=between(1, 2**31))
def skill(
    recording: geometry.Recording,
    model: Simulator,
    leads: Sequence[float],
    *,
    every: int = 1,
    transfer: Transfer | None = None,
    save: bool = False,
    progress: bool = False,
    seed: int = 0,
) -> ForecastSkill:
    """Forecast from every ``every``-th frame and compare with the frames ``leads`` (s) later.

    Errors are pooled over all starts and over all nodes inside both masks; uncovered nodes count as zero velocity.
    A recording with ``weight`` is noisy: ``transfer`` then defaults to the plain fetch. A start whose simulation fails
    is named in ``failures`` and counts nowhere else.

    Raises:
        ValueError: no frame lies a lead after a start, a lead is negative or no number, or the model's scene is of
            another dimension than the recording.
        NumericalFailure: every start failed.
    """
    check_grid(recording.grid, model.scene.dimension)
    if not len(leads):
        raise ValueError("leads must hold at least one time (s) to forecast over")
    if every < 1 or not all(lead >= 0 for lead in leads):
        raise ValueError(f"leads must not be negative (s), and every at least 1, got {list(leads)} and {every}")
    if transfer is None:
        transfer = Transfer() if recording.weight is None else Transfer(fade=None)
    targets = starts(recording, leads, every)
    with tqdm(total=len(targets), desc="forecast", unit="start", disable=None if progress else True) as bar:
        tasks = [
            partial(_from_one_start, recording, model, start, frames, transfer, seed, save, partial(advanced, bar))
            for start, frames in sorted(targets.items())
        ]
        found = shared(tasks)
    failed = [one for one in found if one.failure is not None]
    if len(failed) == len(found):
        raise NumericalFailure(f"all {len(failed)} starts failed, the first: {failed[0].failure}")
    failures = [{"frame": one.frame, "time": float(recording.time[one.frame]), "reason": one.failure} for one in failed]
    rows = [_row(lead, [one.squares[lead] for one in found if lead in one.squares]) for lead in leads]
    kept = {lead: [one.fields[lead] for one in found if lead in one.fields] for lead in leads}
    saved = {lead: _as_recording(recording, frames, lead) for lead, frames in kept.items() if frames}
    totals: dict[str, float] = {}
    for one in found:
        for name, total in one.totals.items():
            totals[name] = totals.get(name, 0) + total
    seconds = {name: sum(one.seconds[name] for one in found) for name in ("setup", "forecast")}
    config = {"spacing": model.scene.spacing, "scheme": repr(model.scheme), "transfer": repr(transfer)}
    return ForecastSkill(rows, seconds, config, saved, totals, failures)


def starts(recording: geometry.Recording, leads: Sequence[float], every: int) -> dict[int, dict[float, int]]:
    """Frame of each lead for every start that has at least one.

    Raises:
        ValueError: no frame lies a lead after a start.
    """
    found: dict[int, dict[float, int]] = {}
    for start in range(0, recording.frames, every):
        for lead in leads:
            later = frame_at(recording.time, recording.time[start] + lead)
            if later is not None:
                found.setdefault(start, {})[lead] = later
    for lead in leads:
        if not any(lead in frames for frames in found.values()):
            raise ValueError(f"no frame of the recording lies {lead:g} s after a start; choose other leads or starts")
    return found


def _from_one_start(
    recording: geometry.Recording,
    model: Simulator,
    start: int,
    frames: dict[float, int],
    transfer: Transfer,
    seed: int,
    save: bool,
    done: Callable[[], object],
) -> _Start:
    """The forecast from one frame to the frame of each lead; ``done`` is called at its end."""
    found = _Start(start)
    try:
        _forecast(recording, model, frames, transfer, seed, save, found)
    except NumericalFailure as fault:
        return _Start(start, seconds=found.seconds, failure=str(fault))
    finally:
        done()
    return found


def _forecast(
    recording: geometry.Recording,
    model: Simulator,
    frames: dict[float, int],
    transfer: Transfer,
    seed: int,
    save: bool,
    found: _Start,
) -> None:
    """Put into ``found`` what a forecast gives at each lead."""
    began, start = clock.perf_counter(), found.frame
    velocity, mask = recording.velocity, np.array(recording.mask, bool)
    known = torch.from_numpy(mask[start] & np.isfinite(velocity[start]).all(0))
    model.domain.prepare_until(float(recording.time[start]), float(recording.time[max(frames.values())]))
    going = GridForecast(
        model,
        recording.grid,
        torch.from_numpy(_filled(recording, start)),
        known.to(model.device),
        float(recording.time[start]),
        transfer,
        seed=seed,
    )
    found.seconds["setup"] += clock.perf_counter() - began
    for lead, frame in sorted(frames.items()):
        began = clock.perf_counter()
        value, covered = going.at(float(recording.time[frame]), torch.from_numpy(mask[frame]).to(model.device))
        field, missing = value[0].cpu().numpy(), int((mask[frame] & ~covered[0].cpu().numpy()).sum())
        found.seconds["forecast"] += clock.perf_counter() - began
        found.squares[lead] = _squares(recording, start, frame, field)
        if save:
            found.fields[lead] = (frame, field.astype(np.float32), missing)
    found.totals.update(going.run.record.totals())


def _filled(recording: geometry.Recording, frame: int) -> np.ndarray:
    """The velocity (D, *shape) of a frame, 0 where there is none."""
    return np.where(np.array(recording.mask[frame], bool), np.nan_to_num(recording.velocity[frame]), 0.0)


def _squares(recording: geometry.Recording, start: int, frame: int, forecast: np.ndarray) -> _Squares:
    """Of a forecast (D, *shape) and of persistence against what a frame holds, where both frames know the blood."""
    both = np.array(recording.mask[start], bool) & np.array(recording.mask[frame], bool)
    first, truth = _filled(recording, start), _filled(recording, frame)

    def total(field: np.ndarray) -> float:
        return float(np.sum(np.square(field[:, both], dtype=np.float64)))

    return _Squares(total(forecast - truth), total(first - truth), total(truth))


def _row(lead: float, squares: Sequence[_Squares]) -> dict[str, Any]:
    """The errors of a lead, pooled over its starts."""
    model, persistence, reference = (sum(column) for column in zip(*squares, strict=True)) if squares else (0.0,) * 3
    scale = reference if reference > 0 else math.nan
    nrmse = {"model": math.sqrt(model / scale), "persistence": math.sqrt(persistence / scale)}
    return {"lead": lead, "starts": len(squares), "nrmse": nrmse}


def _as_recording(
    recording: geometry.Recording, frames: list[tuple[int, np.ndarray, int]], lead: float
) -> geometry.Recording:
    chosen = recording.select(np.array([frame for frame, _, _ in frames]))
    return chosen.with_velocity(
        np.stack([one for _, one, _ in frames]),
        uncovered=np.array([n for _, _, n in frames], np.int64),
        description=f"forecast {1e3 * lead:g} ms ahead",
    )
