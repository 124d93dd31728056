"""The penalised spline of what several measurements see beyond the forecast: an analysis in spline space."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

import regularize
from torchsph.assimilation import Observations

from ..frame_splines import FrameSmoother
from ..measurement.observation_operator import Seen, Source

_LEAST_CONFIDENCE = 1e-3


@dataclass
class Look:
    """All observations of one cycle beside what control and members predict of them.

    Attributes:
        parts: (source, what it saw, index of the time at which it did).
        observations, group: (m,) of all of them, and which learned error scale each belongs to.
        members: (N, m) predicted. regions: masks (m,) by name.
    """

    parts: list[tuple[Source, Seen, int]]
    observations: Observations
    group: Tensor
    members: Tensor
    regions: dict[str, Tensor] = field(default_factory=dict)


class InnovationSpline:
    """Splines of innovations, whose walls are at rest; noise and smoothness are chosen from them as the cycle goes.

    Args:
        splines: of the recording whose walls and nodes they use. choose_every: frames that share one choice.
    """

    def __init__(self, splines: FrameSmoother, choose_every: int) -> None:
        self.splines, self.choose_every = splines, choose_every
        self.choice: regularize.Choice | None = None

    def state(self) -> dict[str, Any] | None:
        return None if self.choice is None else asdict(self.choice)

    def restore(self, state: dict[str, Any] | None) -> None:
        self.choice = None if state is None else regularize.Choice(**state)

    def of(self, values: Tensor, weight: Tensor, look: Look, frame: int) -> Tensor:
        """(k, D, *shape) splines of numbers (k, m) at the observations of positive weight (m,).

        Noise, smoothness and outliers are judged by the first row; of the others the same linear estimate is made.
        """
        rows = _rows(values, weight, look)
        if not rows:
            recording = self.splines.recording
            return torch.zeros((len(values), recording.dimension, *recording.grid.shape))
        full, choice, fitted = [row for row in rows if row[0].beam is None], None, []
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

    def _along(
        self, rows: list[tuple[Seen, Tensor, Tensor]], choice: regularize.Choice | None, frame: int
    ) -> list[regularize.SplineField]:
        """Splines of components along beams, with full vectors among them as three of those each."""
        robust = None if choice is None else choice.robust
        dimension = self.splines.recording.dimension
        points, samples, deviation, beams, known = _along_beams(rows, dimension, choice, robust)
        confidence = (deviation.quantile(0.05) / deviation).clamp(_LEAST_CONFIDENCE, 1.0)
        # the penalties keep their own precision where more is known of the samples
        more = float((deviation[known] ** -2).sum() / (deviation**-2).sum())
        if choice is not None:
            slip = None if choice.no_slip is None else choice.no_slip * more**0.5
            choice = replace(choice, curvature=choice.curvature * more**0.25, no_slip=slip)
        return [self.splines.fit_along(frame, points, one, confidence, beams, choice) for one in samples]


def _rows(values: Tensor, weight: Tensor, look: Look) -> list[tuple[Seen, Tensor, Tensor]]:
    """What each source says (k, n, parts) at its good places, and which those are (q,); sources with none left out."""
    start, rows = 0, []
    for _, seen, _ in look.parts:
        m = len(seen.observations)
        good = (weight[start : start + m].reshape(seen.parts, -1) > 0).all(0)
        if bool(good.any()):
            own = values[:, start : start + m].reshape(len(values), seen.parts, -1)
            rows.append((seen, own.transpose(1, 2)[:, good], good))
        start += m
    return rows


def _along_beams(
    rows: list[tuple[Seen, Tensor, Tensor]], dimension: int, choice: regularize.Choice | None, robust: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Samples of all sources as components along unit vectors.

    Returns points (n, D), velocities (k, n, D), white-equivalent deviations (n,), unit vectors (n, D), and which rows
    (n,) are parts of full vectors. Those have the noise of ``choice`` and, in their order, the factors ``robust``.
    """
    points, samples, beams, deviations, known, start = [], [], [], [], [], 0
    for seen, value, good in rows:
        count = int(good.sum())
        spread = (seen.observations.variance * seen.observations.redundancy).reshape(seen.parts, -1)[:, good].sqrt()
        factor = torch.ones(count, dtype=torch.float64)
        if seen.beam is None and robust is not None:
            factor = robust[start : start + count].double().clamp_min(_LEAST_CONFIDENCE**2)
            start += count
        for part in range(seen.parts):
            axis = torch.eye(dimension, dtype=torch.float64)[part].expand(count, -1)
            beam = axis if seen.beam is None else seen.beam[good]
            own = spread[part]
            if seen.beam is None and choice is not None:
                own = choice.noise[part] / (seen.confidence[good] * factor.sqrt())
            points.append(seen.position[good])
            samples.append(value[..., part : part + 1] * beam)
            beams.append(beam / beam.norm(dim=1, keepdim=True).clamp_min(1e-12))
            deviations.append(own)
            known.append(torch.full((count,), seen.beam is None))
    return torch.cat(points), torch.cat(samples, 1), torch.cat(deviations), torch.cat(beams), torch.cat(known)
