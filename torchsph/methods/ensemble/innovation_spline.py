"""The penalised spline of what several measurements see beyond the forecast: an analysis in spline space."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

import regularize

from ..measurement.frame_splines import FrameSmoother
from ..measurement.observation_batch import ObservationBatch
from ..measurement.observation_operator import FrameObservations

_LEAST_CONFIDENCE = 1e-3


class Row(NamedTuple):
    """What one part of a batch says: its frame, values (k, n, parts) at its n good places, and which those are (q,)."""

    seen: FrameObservations
    values: Tensor
    good: Tensor


class InnovationSpline:
    """Splines of innovations, whose walls are at rest; noise and smoothness are chosen from them as the cycle goes.

    Args:
        splines: of the recording whose walls and nodes they use. choose_every: frames that share one choice.
    """

    def __init__(self, splines: FrameSmoother, choose_every: int) -> None:
        self.splines, self.choose_every = splines, choose_every
        self.choice: regularize.Choice | None = None

    def state(self) -> dict[str, Any] | None:
        """What a checkpoint has to hold."""
        return None if self.choice is None else asdict(self.choice)

    def restore(self, state: dict[str, Any] | None) -> None:
        """Go on from what ``state`` gave."""
        self.choice = None if state is None else regularize.Choice(**state)

    def of(self, values: Tensor, weight: Tensor, batch: ObservationBatch, frame: int) -> Tensor:
        """(k, D, *shape) splines of numbers (k, m) at the observations of positive weight (m,).

        Noise, smoothness and outliers are judged by the first row; of the others the same linear estimate is made.
        """
        rows = _rows(values, weight, batch)
        if not rows:
            recording = self.splines.recording
            return torch.zeros((len(values), recording.dimension, *recording.grid.shape))
        full, choice, fitted = [row for row in rows if row.seen.components.full], None, []
        if full:
            each = [(seen.position[good], some, seen.confidence[good]) for seen, some, good in full]
            points, samples, confidence = zip(*each, strict=True)
            anew = (frame - 1) % self.choose_every == 0
            fitted = self.splines.fit_increments(
                frame,
                torch.cat(points),
                torch.cat(samples, 1),
                torch.cat(confidence),
                choice=None if anew else self.choice,
            )
            self.choice = choice = fitted[0].choice
        if len(full) < len(rows):
            fitted = self._along(rows, choice, frame)
        return torch.stack([torch.from_numpy(self.splines.on_grid(one, frame)) for one in fitted])

    def _along(self, rows: list[Row], choice: regularize.Choice | None, frame: int) -> list[regularize.SplineField]:
        """Splines of components along directions, with full vectors among them as one along each axis."""
        robust = None if choice is None else choice.robust
        points, samples, deviation, directions, known = _along_directions(rows, choice, robust)
        confidence = (deviation.quantile(0.05) / deviation).clamp(_LEAST_CONFIDENCE, 1.0)
        # the penalties keep their own precision where more is known of the samples
        more = float((deviation[known] ** -2).sum() / (deviation**-2).sum())
        if choice is not None:
            slip = None if choice.no_slip is None else choice.no_slip * more**0.5
            choice = replace(choice, curvature=choice.curvature * more**0.25, no_slip=slip)
        return [self.splines.fit_along(frame, points, one, confidence, directions, choice) for one in samples]


def _rows(values: Tensor, weight: Tensor, batch: ObservationBatch) -> list[Row]:
    """What each part of the batch says; parts without a good place are left out."""
    rows: list[Row] = []
    start = 0
    for _, seen, _ in batch.parts:
        m = len(seen.observations)
        good = (weight[start : start + m].reshape(seen.parts, -1) > 0).all(0)
        if bool(good.any()):
            own = values[:, start : start + m].reshape(len(values), seen.parts, -1)
            rows.append(Row(seen, own.transpose(1, 2)[:, good], good))
        start += m
    return rows


def _along_directions(
    rows: list[Row], choice: regularize.Choice | None, robust: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Samples of all parts as components along unit vectors.

    Args:
        rows: of the batch.
        choice: whose noise full vectors have, where there is one.
        robust: factors on the weights of the full vectors, in their order.

    Returns:
        Points (n, D), velocities (k, n, D), white-equivalent deviations (n,), unit vectors (n, D), and which rows (n,)
        are parts of full vectors.
    """
    points, samples, along, deviations, known, start = [], [], [], [], [], 0
    for seen, value, good in rows:
        count, full = int(good.sum()), seen.components.full
        spread = (seen.observations.variance * seen.observations.redundancy).reshape(seen.parts, -1)[:, good].sqrt()
        factor = torch.ones(count, dtype=torch.float64)
        if full and robust is not None:
            factor = robust[start : start + count].double().clamp_min(_LEAST_CONFIDENCE**2)
            start += count
        for part, direction in enumerate(seen.components.directions[:, good]):
            own = spread[part]
            if full and choice is not None:
                own = choice.noise[part] / (seen.confidence[good] * factor.sqrt())
            points.append(seen.position[good])
            samples.append(value[..., part : part + 1] * direction)
            along.append(direction / direction.norm(dim=1, keepdim=True).clamp_min(1e-12))
            deviations.append(own)
            known.append(torch.full((count,), full))
    return torch.cat(points), torch.cat(samples, 1), torch.cat(deviations), torch.cat(along), torch.cat(known)
