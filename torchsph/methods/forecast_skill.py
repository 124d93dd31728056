"""How good the simulator's forecasts are against a recording's later frames, by lead time."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

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


@dataclass(frozen=True)
class ForecastSkill:
    """Errors of forecasts against lead time.

    Attributes:
        leads: one entry per lead: ``{"lead": s, "starts": n, "nrmse": {"model": x, "persistence": y}}``.
        seconds: ``{"setup": s, "forecast": s}``. config: what was run.
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


@dataclass
class _Sums:
    """Pooled squares of one lead: model error, persistence error, reference; and the number of starts."""

    model: float = 0.0
    persistence: float = 0.0
    reference: float = 0.0
    starts: int = 0

    def add(self, forecast: np.ndarray, start: np.ndarray, truth: np.ndarray, both: np.ndarray) -> None:
        def total(field: np.ndarray) -> float:
            return float(np.sum(np.square(field[:, both], dtype=np.float64)))

        self.model += total(forecast - truth)
        self.persistence += total(start - truth)
        self.reference += total(truth)
        self.starts += 1

    def nrmse(self) -> dict[str, float]:
        scale = self.reference if self.reference > 0 else math.nan
        return {"model": math.sqrt(self.model / scale), "persistence": math.sqrt(self.persistence / scale)}


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
    targets = _targets(recording, leads, every)
    sums = {lead: _Sums() for lead in leads}
    kept: dict[float, list[tuple[int, np.ndarray, int]]] = {lead: [] for lead in leads}
    seconds = {"setup": 0.0, "forecast": 0.0}
    totals: dict[str, float] = {}
    failures: list[dict[str, Any]] = []
    bar = tqdm(sorted(targets), desc="forecast", unit="start", disable=None if progress else True)
    for start in bar:
        try:
            forecasts = _from_one_start(recording, model, start, targets[start], transfer, seed, seconds, totals)
        except NumericalFailure as fault:
            failures.append({"frame": start, "time": float(recording.time[start]), "reason": str(fault)})
            continue
        for lead, (frame, value, missing) in forecasts.items():
            _compare(recording, start, frame, value, sums[lead])
            if save:
                kept[lead].append((frame, value.astype(np.float32), missing))
    if len(failures) == len(targets):
        raise NumericalFailure(f"all {len(failures)} starts failed, the first: {failures[0]['reason']}")
    rows = [{"lead": lead, "starts": sums[lead].starts, "nrmse": sums[lead].nrmse()} for lead in leads]
    saved = {lead: _as_recording(recording, frames, lead) for lead, frames in kept.items() if frames}
    config = {"spacing": model.scene.spacing, "scheme": repr(model.scheme), "transfer": repr(transfer)}
    return ForecastSkill(rows, seconds, config, saved, totals, failures)


def _targets(recording: geometry.Recording, leads: Sequence[float], every: int) -> dict[int, dict[float, int]]:
    """Frame of each lead for every start that has at least one."""
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
    seconds: dict[str, float],
    totals: dict[str, float],
) -> dict[float, tuple[int, np.ndarray, int]]:
    """For each lead the frame that it reaches, the forecast there (D, *shape), m/s, and the nodes that it lacks."""
    began = clock.perf_counter()
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
    seconds["setup"] += clock.perf_counter() - began
    found = {}
    for lead, frame in sorted(frames.items()):
        began = clock.perf_counter()
        value, covered = going.at(float(recording.time[frame]), torch.from_numpy(mask[frame]).to(model.device))
        missing = int((mask[frame] & ~covered[0].cpu().numpy()).sum())
        found[lead] = (frame, value[0].cpu().numpy(), missing)
        seconds["forecast"] += clock.perf_counter() - began
    for name, total in going.run.record.totals().items():
        totals[name] = totals.get(name, 0) + total
    return found


def _filled(recording: geometry.Recording, frame: int) -> np.ndarray:
    """The velocity (D, *shape) of a frame, 0 where there is none."""
    return np.where(np.array(recording.mask[frame], bool), np.nan_to_num(recording.velocity[frame]), 0.0)


def _compare(recording: geometry.Recording, start: int, frame: int, value: np.ndarray, sums: _Sums) -> None:
    """Add a forecast (D, *shape) and persistence against what a frame holds, where both frames know the blood."""
    both = np.array(recording.mask[start], bool) & np.array(recording.mask[frame], bool)
    sums.add(value, _filled(recording, start), _filled(recording, frame), both)


def _as_recording(
    recording: geometry.Recording, frames: list[tuple[int, np.ndarray, int]], lead: float
) -> geometry.Recording:
    chosen = recording.select(np.array([frame for frame, _, _ in frames]))
    return chosen.with_velocity(
        np.stack([one for _, one, _ in frames]),
        uncovered=np.array([n for _, _, n in frames], np.int64),
        description=f"forecast {1e3 * lead:g} ms ahead",
    )
