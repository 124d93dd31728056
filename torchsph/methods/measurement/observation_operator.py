"""What a measurement sees of a velocity field: blur of its kernel, its own grid, its beam, its frames and errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import geometry
from geometry.grids.fields import fwhm_to_deviation, masked_blur
from torchsph.assimilation import Observations, Reason

from ..frame_splines import beam_at, node_weights
from .error_model import ObservationError

# share of the nodes around a point that must lie in the blood for the field to be known there
_LEAST_SHARE = 1e-3
# a place that was measured at all keeps some say
_LEAST_CONFIDENCE = 0.02


@dataclass(frozen=True)
class Seen:
    """The observations of one frame of one source: m = parts * q numbers at q places, component-major.

    Attributes:
        frame: of the source. node: (q,) flat indices into the source's grid. position: (q, D), m.
        observations: their variances as the error model states them. beam: (q, D) or None for full vectors.
        confidence: (q,) in (0, 1], what a place counts for in a spline.
    """

    frame: int
    node: Tensor
    position: Tensor
    observations: Observations
    beam: Tensor | None
    confidence: Tensor

    @property
    def parts(self) -> int:
        """Numbers per place: D components, or one along the beam."""
        return len(self.observations) // max(len(self.position), 1) if len(self.position) else 0


class Source:
    """One measurement of the beat, and what it would see of fields on the grid of the state.

    Args:
        recording: with its own grid, times and errors. error: its error model. grid: of the state.
        kernel: full width at half maximum (m) of the measurement's resolution; None takes the error model's.
    """

    def __init__(
        self, recording: geometry.Recording, error: ObservationError, grid: geometry.Grid, kernel: float | None = None
    ) -> None:
        self.recording, self.error, self.grid = recording, error, grid
        self.kernel = error.kernel if kernel is None else kernel
        self.nodes = recording.grid.nodes()
        self.same_grid = recording.grid == grid
        self.groups = 1 if recording.beam is not None else recording.dimension

    def frames_within(self, after: float, until: float, tolerance: float = 1e-6) -> list[int]:
        """Frames later than ``after`` and not later than ``until`` (s), in order."""
        time = self.recording.time
        return np.flatnonzero((time > after + tolerance) & (time <= until + tolerance)).tolist()

    def see(self, frame: int) -> Seen:
        """The observations of a frame: every node inside the source's mask, missing ones with their reason."""
        recording = self.recording
        node = torch.from_numpy(np.flatnonzero(recording.mask[frame]))
        weight = torch.from_numpy(node_weights(recording, frame).astype(np.float64).reshape(-1))[node]
        variance = torch.from_numpy(self.error.variance(recording, frame)).flatten(1)[:, node]
        value = torch.from_numpy(recording.velocity[frame].astype(np.float64)).flatten(1)[:, node]
        beam = beam_at(recording, frame)
        if beam is not None:
            beam = torch.from_numpy(beam.astype(np.float64)).flatten(1)[:, node]
            value, variance = (value * beam).sum(0, keepdim=True), variance.mean(0, keepdim=True)
        missing = ~torch.isfinite(value).all(0)
        silent = torch.where(missing, int(Reason.MISSING), torch.where(weight > 0, 0, int(Reason.NO_WEIGHT)))
        observations = Observations(
            torch.nan_to_num(value).flatten(),
            torch.where(silent == 0, variance, torch.inf).flatten(),
            position=self.nodes[node],
            redundancy=float(self.error.redundancy[frame]),
            reason=silent.to(torch.uint8).repeat(len(value)),
        )
        return Seen(
            frame,
            node,
            self.nodes[node],
            observations,
            None if beam is None else beam.T,
            self._confidence(frame, node, silent == 0),
        )

    def _confidence(self, frame: int, node: Tensor, used: Tensor) -> Tensor:
        """(q,) inverse deviations relative to the best, without what outliers lose: a spline judges those itself."""
        calm = self.error.variance(self.recording, frame).mean(0) / self.error.surprise[frame]
        calm = torch.from_numpy(calm.reshape(-1))[node]
        if not bool(used.any()):
            return torch.zeros_like(calm)
        best = calm[used].quantile(0.05)
        return torch.where(used, (best / calm).sqrt().clamp(_LEAST_CONFIDENCE, 1.0), 0.0)

    def predict(self, field: Tensor, mask: Tensor, seen: Seen) -> Tensor:
        """(B, m) what the source would see of fields (B, D, *shape) on the state's grid, known on ``mask`` (*shape).

        NaN at places with no node of the mask around them.
        """
        count, parts = field.shape[:2]
        flat = field.reshape(count * parts, *field.shape[2:]).to(torch.float32)
        inside = mask.to(torch.bool)
        if self.kernel > 0:
            flat = masked_blur(flat, inside, fwhm_to_deviation(self.kernel), tuple(self.grid.spacing))
        if self.same_grid:
            known = inside.reshape(-1)[seen.node]
            sampled = flat.flatten(1)[:, seen.node]
        else:
            share = self.grid.sample(inside.to(torch.float32)[None], seen.position)[0]
            known = share > _LEAST_SHARE
            sampled = self.grid.sample(flat * inside, seen.position) / share.clamp_min(_LEAST_SHARE)
        sampled = torch.where(known, sampled, torch.nan).double().reshape(count, parts, -1)
        if seen.beam is not None:
            sampled = (sampled * seen.beam.T).sum(1, keepdim=True)
        return sampled.flatten(1)
